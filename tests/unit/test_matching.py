"""Matching by mutual nearest neighbours and by networks."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.unit import graphs
from trigpoint.errors import ModelError
from trigpoint.frame import quantize_descriptors
from trigpoint.models.matching import (
    Matchable,
    MutualNearestNeighbors,
    OnnxMatcher,
    load_matcher,
    match_mutual,
)
from trigpoint_db.adapt import adapt_model

DIM = graphs.DIM


def unit(seed: int, num: int) -> NDArray[np.float32]:
    vectors = np.random.default_rng(seed).normal(size=(num, DIM)).astype(np.float32)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def matchable(seed: int, num: int) -> Matchable:
    points = np.random.default_rng(seed).uniform(0, 480, (num, 2)).astype(np.float32)
    return Matchable(points, unit(seed, num), 640, 480)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 40), m=st.integers(0, 40))
def test_matches_are_each_others_nearest_neighbours(seed: int, n: int, m: int) -> None:
    query, anchor = unit(seed, n), unit(seed + 1, m)
    matches, similarities = match_mutual(query, anchor)
    table = query @ anchor.T
    expected = {
        (i, j)
        for i in range(n)
        for j in range(m)
        if table[i, j] == table[i].max() and table[i, j] == table[:, j].max()
    }
    assert {(int(i), int(j)) for i, j in matches} == expected
    assert (np.diff(similarities) <= 0).all()
    np.testing.assert_array_equal(similarities, table[matches[:, 0], matches[:, 1]])


def test_a_shuffled_copy_is_matched_wholly() -> None:
    descriptors = unit(0, 100)
    order = np.random.default_rng(1).permutation(100)
    matches, similarities = match_mutual(descriptors, descriptors[order])
    assert len(matches) == 100
    np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])
    np.testing.assert_allclose(similarities, 1, atol=1e-5)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 60), m=st.integers(0, 60))
def test_integers_match_as_the_floats_that_they_stand_for(seed: int, n: int, m: int) -> None:
    query, anchor = matchable(seed, n), matchable(seed + 1, m)
    anchor = replace(anchor, descriptors=quantize_descriptors(anchor.normalized))
    matches, cosines = MutualNearestNeighbors().match(query, anchor)
    table = query.right.T.astype(np.float64) @ anchor.descriptors.T
    expected = {
        (i, j)
        for i in range(n)
        for j in range(m)
        if table[i, j] == table[i].max() and table[i, j] == table[:, j].max()
    }
    found = {(int(i), int(j)) for i, j in matches}
    assert found <= expected
    # Of equally near ones, which is taken does not matter.
    clear = {
        (i, j)
        for i, j in expected
        if (table[i] == table[i, j]).sum() == (table[:, j] == table[i, j]).sum() == 1
    }
    assert clear <= found
    assert all(len(set(side)) == len(matches) for side in matches.T)
    true = (query.normalized @ anchor.normalized.T)[matches[:, 0], matches[:, 1]]
    np.testing.assert_allclose(cosines, true, atol=0.03)
    assert (np.diff(cosines) <= 0).all()


def test_no_sum_of_integers_saturates() -> None:
    """Where x86 has no VNNI, two products of 8 bits are added in 16."""
    largest = np.zeros((1, 64), np.float32)
    largest[0, :2] = np.sqrt(0.5)  # beyond the range, so 127 and 63
    image = Matchable(np.zeros((1, 2), np.float32), largest, 640, 480)
    assert int(image.left.max()) * int(image.right.max()) * 2 == 255 * 63 * 2 < 2**15
    _, cosine = MutualNearestNeighbors().match(image, image)
    assert cosine[0] == pytest.approx(0.5)


def test_equal_descriptors_are_in_one_match_each() -> None:
    descriptors = np.repeat(unit(0, 5), 3, axis=0)
    points = np.zeros((15, 2), np.float32)
    image = Matchable(points, descriptors, 640, 480)
    for matches, _ in (
        match_mutual(descriptors, descriptors),
        MutualNearestNeighbors().match(image, image),
    ):
        assert len(matches) == 5
        assert all(len(set(side)) == 5 for side in matches.T)


def test_the_packaged_graph_is_what_its_script_writes() -> None:
    products = pytest.importorskip("training.products")
    assert products.make_graph().SerializeToString() == Path(products.PATH).read_bytes()


def adapted(source: Path, **fields: Any) -> OnnxMatcher:
    """Write a contract into a matcher and load it."""
    contract = {"kind": "matcher", "name": "foreign", "descriptor_dim": DIM, "min_score": -1.0}
    out = source.with_name("adapted.onnx")
    adapt_model(source, out, contract | fields)
    return OnnxMatcher.load(out, fields.get("descriptor_dim", DIM), num_threads=1)


@pytest.mark.parametrize("form", ["(P, 2)", "(1, P, 2)", "(P, 3)", "(1, N)"])
def test_a_network_matches_in_any_form(tmp_path: Path, form: str) -> None:
    """It computes mutual nearest neighbours inside: the same as ours."""
    matcher = adapted(graphs.mutual_matcher(tmp_path / "matcher.onnx", form))
    query, anchor = matchable(0, 60), matchable(1, 50)
    matches, scores = matcher.match(query, anchor)
    expected, similarities = match_mutual(query.normalized, anchor.normalized)
    assert len(matches) > 5
    np.testing.assert_array_equal(matches, expected)
    np.testing.assert_allclose(scores, similarities, atol=1e-5)


def test_keypoints_are_centered_as_lightglue_wants_them(tmp_path: Path) -> None:
    """Matched by place, an image and its copy at twice the size are the same, except in px."""
    source = graphs.mutual_matcher(tmp_path / "matcher.onnx", "(P, 2)", by="kpts")
    small = matchable(0, 50)
    large = Matchable(small.keypoints * 2, small.descriptors, 1280, 960)
    centered = adapted(source, keypoints="centered", min_score=-1e9)
    assert [(i, i) for i in range(50)] == sorted(map(tuple, centered.match(small, large)[0]))
    px = adapted(source, keypoints="px", min_score=-1e9)
    assert len(px.match(small, large)[0]) < 25


def test_a_keypoint_keeps_its_best_match_only(tmp_path: Path) -> None:
    pairs = [[0, 1], [5, 5], [0, 2], [3, 2], [4, 4], [6, 6]]
    scores = [0.5, 0.05, 0.9, 0.7, 0.8, np.nan]
    path = graphs.constant_matcher(tmp_path / "matcher.onnx", pairs, scores)
    matches, kept = adapted(path, min_score=0.1).match(matchable(0, 9), matchable(1, 9))
    assert matches.tolist() == [[0, 2], [4, 4]]
    np.testing.assert_allclose(kept, [0.9, 0.8])


def test_nothing_is_matched_where_there_is_next_to_nothing(tmp_path: Path) -> None:
    matcher = adapted(graphs.mutual_matcher(tmp_path / "matcher.onnx", "(P, 2)"))
    for n, m in ((0, 9), (9, 3), (0, 0)):
        matches, scores = matcher.match(matchable(0, n), matchable(1, m))
        assert matches.shape == (0, 2)
        assert scores.shape == (0,)


@pytest.mark.parametrize(
    ("pairs", "scores", "message"),
    [
        ([[0, 9]], [1.0], "a match of a keypoint that there is not, of 20 and 9"),
        ([[-1, 2]], [1.0], "a match of a keypoint that there is not"),
        ([[0, 1], [1, 2]], [1.0], "gave 2 matches and 1 scores"),
    ],
)
def test_matches_that_cannot_be_are_errors(
    tmp_path: Path, pairs: list[list[int]], scores: list[float], message: str
) -> None:
    path = graphs.constant_matcher(tmp_path / "plain.onnx", [[0, 1]], [1.0])
    matcher = adapted(path)
    broken = graphs.constant_matcher(
        tmp_path / "broken.onnx", pairs, scores, metadata=matcher.network.contract.to_json()
    )
    with pytest.raises(ModelError, match=message):
        OnnxMatcher.load(broken, DIM).match(matchable(0, 20), matchable(1, 9))


def test_a_network_that_cannot_run_says_so_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="the network 'foreign' cannot run") as caught:
        adapted(graphs.failing_matcher(tmp_path / "matcher.onnx"))
    assert "\n" not in str(caught.value)


def test_a_matcher_for_other_descriptors_is_refused(tmp_path: Path) -> None:
    adapted(graphs.mutual_matcher(tmp_path / "matcher.onnx", "(P, 2)"))
    with pytest.raises(ModelError, match="of 16 numbers, and the feature network's have 64"):
        load_matcher(tmp_path / "adapted.onnx", 64)
    assert isinstance(load_matcher(None, 64), MutualNearestNeighbors)


def test_a_matcher_of_a_fixed_number_of_keypoints_is_refused(tmp_path: Path) -> None:
    graph = graphs.Graph(
        kpts0=[1, 512, 2], kpts1=[1, 512, 2], desc0=[1, 512, DIM], desc1=[1, 512, DIM]
    )
    outputs: dict[str, tuple[str, graphs.Shape]] = {
        "matches": (graph.constant([[0, 0]], np.int64), ["num", 2]),
        "scores": (graph.constant([1.0]), ["num"]),
    }
    path = graph.save(tmp_path / "fixed.onnx", outputs, integers=("matches",))
    with pytest.raises(ModelError, match="matches just 512 keypoints; export it with a dynamic"):
        adapted(path)
