"""The map against known contents."""

import gc
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from weakref import getweakrefs

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.unit.maps import MODEL, add, make_features, make_map, make_pose, require_image
from trigpoint.camera import PARAMETERS, Camera
from trigpoint.database import schema
from trigpoint.database.ranking import POOL
from trigpoint.database.reader import MapReader
from trigpoint.database.rows import quantize_row
from trigpoint.database.snapshot import Snapshot, share_environment
from trigpoint.database.writer import MapWriter
from trigpoint.errors import DatabaseError
from trigpoint.frame import LocalFeatures, restore_descriptors
from trigpoint.rigid import Rigid3


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**32 - 1),
    num_keypoints=st.integers(0, 200),
    dim=st.sampled_from([8, 16, 64]),
    size=st.tuples(st.integers(1, 5000), st.integers(1, 5000)),
)
@example(seed=1, num_keypoints=1024, dim=64, size=(640, 480))  # five keypoints beside the pose
@example(seed=1, num_keypoints=64, dim=64, size=(640, 480))  # a page and more than all of them
def test_an_image_comes_back_within_its_quantisation(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    num_keypoints: int,
    dim: int,
    size: tuple[int, int],
) -> None:
    model = replace(MODEL, descriptor_dim=dim)
    camera = Camera("OPENCV", *size, tuple(np.random.default_rng(seed).uniform(0.1, 900, 8)))
    features, pose = make_features(seed, num_keypoints, model, camera), make_pose(seed)
    path = tmp_path_factory.mktemp("map") / "a.tpmap"
    with MapWriter.create(path, model) as writer:
        assert writer.add("größer/1.png", camera, pose, features) == 0
    with MapReader.open(path, model) as reader:
        anchor = reader.anchor(0)
        assert reader.verify() == []
    assert (anchor.name, anchor.camera) == ("größer/1.png", camera)
    np.testing.assert_allclose(anchor.cam_from_world.R, pose.R, atol=1e-14)
    np.testing.assert_array_equal(anchor.cam_from_world.t, pose.t)
    half_step_px = max(size) / 65_535 / 2
    assert anchor.keypoints.dtype == np.float32
    np.testing.assert_allclose(anchor.keypoints, features.keypoints, atol=1.05 * half_step_px)
    assert anchor.descriptors.shape == features.descriptors.shape
    # Half a step of 4 / (127 sqrt(D)) in each of D numbers turns a unit vector by 2 / 127 at most.
    error = np.linalg.norm(restore_descriptors(anchor.descriptors) - features.descriptors, axis=1)
    assert (error <= 2 / 127 * 1.01).all()


@pytest.mark.parametrize("model", PARAMETERS)
def test_every_camera_model_comes_back_exactly(tmp_path: Path, model: str) -> None:
    params = tuple(0.1 + 7 * i / 3 for i in range(len(PARAMETERS[model])))
    camera = Camera(model, 640, 480, params)
    with MapWriter.create(tmp_path / "a.tpmap", MODEL) as writer:
        add(writer, 0, camera=camera)
    with MapReader.open(tmp_path / "a.tpmap") as reader:
        assert reader.anchor(0).camera == camera


def test_an_image_of_1024_keypoints_takes_less_than_72_kilobytes(tmp_path: Path) -> None:
    model = replace(MODEL, descriptor_dim=64, global_dim=512)
    with MapWriter.create(tmp_path / "a.tpmap", model) as writer:
        for index in range(24):
            add(writer, index, features=make_features(index, 1024, model))
    assert (tmp_path / "a.tpmap").stat().st_size / 24 < 72_000


def test_images_added_after_reopening_follow_the_others(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 250)
    for first, last in ((250, 260), (260, 300)):  # across the end of a retrieval block
        with MapWriter.open(path, MODEL) as writer:
            assert [add(writer, index) for index in range(first, last)] == [*range(first, last)]
    with MapReader.open(path) as reader:
        assert reader.verify() == []
        assert reader.names() == [f"folder/{index}.png" for index in range(300)]
        for index in (0, 249, 250, 256, 299):
            require_image(reader, index)
            found, similarities = reader.search(make_features(index).global_descriptor, 1)
            assert found.tolist() == [index]
            np.testing.assert_allclose(similarities, 1, atol=1e-3)


def test_the_generation_rises_with_each_commit_that_changes_something(tmp_path: Path) -> None:
    path = tmp_path / "a.tpmap"
    with MapWriter.create(path, MODEL) as writer, MapReader.open(path) as reader:
        generations = [reader.generation]
        for index in (0, None, 1):
            if index is not None:
                add(writer, index)
            writer.commit()
            reader.refresh()
            generations.append(reader.generation)
        assert generations == [0, 1, 1, 2]
        assert (reader.model, len(reader), len(writer)) == (MODEL, 2, 2)


def test_an_exception_drops_what_was_not_committed(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with suppress(KeyboardInterrupt), MapWriter.open(path, MODEL) as writer:
        add(writer, 3)
        writer.commit()
        add(writer, 4)
        raise KeyboardInterrupt
    with MapReader.open(path) as reader:
        assert (len(reader), reader.verify()) == (4, [])


def changed(**arrays: NDArray[np.float32]) -> LocalFeatures:
    return replace(make_features(9), **arrays)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "folder/0.png"}, "holds an image 'folder/0.png' already"),
        ({"name": ""}, "has 0 bytes"),
        ({"name": "ä" * 251}, "has 502 bytes"),
        ({"name": "\udcff"}, "not valid Unicode"),
        ({"cam_from_world": Rigid3(np.eye(3), np.array([0, np.nan, 0]))}, "not finite"),
        ({"cam_from_world": Rigid3(np.eye(3), np.array([0, 1e300, 0]))}, r"beyond 1e\+09 units"),
        ({"cam_from_world": Rigid3(-np.eye(3), np.zeros(3))}, "is no rotation"),
        ({"cam_from_world": Rigid3.stack([make_pose(0)])}, "is a batch"),
        ({"features": make_features(9, model=replace(MODEL, descriptor_dim=8))}, "descriptors"),
        ({"features": make_features(9, model=replace(MODEL, global_dim=8))}, "global_descriptor"),
        ({"features": changed(keypoints=np.zeros((39, 2), np.float32))}, r"\(39, 16\)"),
        ({"features": changed(keypoints=np.full((40, 2), 480, np.float32))}, "outside"),
        ({"features": changed(keypoints=np.full((40, 2), -0.6, np.float32))}, "outside"),
        ({"features": changed(descriptors=np.full((40, 16), np.nan, np.float32))}, "not finite"),
        ({"features": make_features(9, schema.MAX_KEYPOINTS + 1)}, "65536 keypoints"),
    ],
)
def test_what_cannot_be_added_is_refused_and_leaves_no_trace(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = make_map(tmp_path / "a.tpmap", 1)
    with MapWriter.open(path, MODEL) as writer:
        with pytest.raises(DatabaseError, match=message) as caught:
            add(writer, 9, **changes)
        assert "\n" not in str(caught.value)
        assert add(writer, 1) == 1
    with MapReader.open(path) as reader:
        assert (reader.names(), reader.verify()) == (["folder/0.png", "folder/1.png"], [])


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), k=st.integers(0, 320))
def test_search_equals_brute_force_on_the_stored_rows(
    tmp_path_factory: pytest.TempPathFactory, seed: int, k: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "search.tpmap"
    if not path.exists():
        make_map(path, 300)
    stored = [
        scale * row.astype(np.float64)
        for scale, row in (
            quantize_row(make_features(index).global_descriptor) for index in range(300)
        )
    ]
    query = make_features(seed).global_descriptor
    with MapReader.open(path) as reader:
        indices, similarities = reader.search(query, k)
    expected = np.array(stored) @ query.astype(np.float64)
    best = np.sort(expected)[::-1][:k]
    assert len(indices) == len(set(indices.tolist())) == min(k, 300)
    np.testing.assert_allclose(similarities, best, atol=1e-6)
    np.testing.assert_allclose(expected[indices], best, atol=1e-6)


def test_a_diverse_search_passes_over_what_looks_like_a_better_image(tmp_path: Path) -> None:
    """Thirty near copies of a wrong view, which look most like the query, hide the right one."""
    query, wrong, right = np.eye(32, dtype=np.float32)[:3]
    rng = np.random.default_rng(0)
    with MapWriter.create(tmp_path / "a.tpmap", MODEL) as writer:
        for index in range(31):
            view = 0.6 * query + 0.8 * wrong if index < 30 else 0.5 * query + 0.87 * right
            row = view + rng.normal(0, 0.01, 32).astype(np.float32)
            features = replace(make_features(index), global_descriptor=row / np.linalg.norm(row))
            add(writer, index, features=features)
    with MapReader.open(tmp_path / "a.tpmap") as reader:
        assert 30 not in reader.search(query, 10)[0]
        found, similarities = reader.search(query, 10, diversity=0.3)
        everything = reader.search(query, 31)[0]
    assert found[:2].tolist() == [everything[0], 30]
    assert similarities[1] < similarities[2]


@settings(max_examples=25)
@given(k=st.integers(1, 40), diversity=st.floats(0.01, 1), seed=st.integers(0, 99))
@example(k=15, diversity=0.99999, seed=31)  # all like the first, and so nearly equal
def test_a_diverse_search_is_the_greedy_choice(
    tmp_path_factory: pytest.TempPathFactory, k: int, diversity: float, seed: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "diverse.tpmap"
    if not path.exists():
        make_map(path, 300)
    query = make_features(seed).global_descriptor
    with MapReader.open(path) as reader:
        pool, likeness = reader.search(query, POOL * k)
        found, _ = reader.search(query, k, diversity)
    stored = [quantize_row(make_features(i).global_descriptor) for i in pool.tolist()]
    rows = np.array([scale * row.astype(np.float64) for scale, row in stored])
    place_of = {image: place for place, image in enumerate(pool.tolist())}
    chosen = [place_of[image] for image in found.tolist()]
    assert len(set(chosen)) == min(k, 300)
    for number, place in enumerate(chosen):
        nearest = (rows @ rows[chosen[:number]].T).max(axis=1, initial=0.0)
        scores = likeness - diversity * nearest
        scores[chosen[:number]] = -np.inf
        assert scores[place] > scores.max() - 1e-5  # the rounding of float32


def test_equally_similar_images_come_in_the_order_they_were_added(tmp_path: Path) -> None:
    with MapWriter.create(tmp_path / "a.tpmap", MODEL) as writer:
        for index in range(280):
            add(writer, index, features=make_features(index % 3))
    with MapReader.open(tmp_path / "a.tpmap") as reader:
        for k in (1, 50, 280):
            found, similarities = reader.search(make_features(0).global_descriptor, k)
            assert found[:94].tolist() == [*range(0, 280, 3)][:k]
            assert np.lexsort((found, -similarities)).tolist() == [*range(k)]


def test_the_poses_of_all_images_come_by_index(tmp_path: Path) -> None:
    for num_images in (0, 3):
        with MapReader.open(make_map(tmp_path / f"{num_images}.tpmap", num_images)) as reader:
            poses = reader.poses()
            assert (poses.R.shape, poses.center.shape) == ((num_images, 3, 3), (num_images, 3))
            for index in range(num_images):
                np.testing.assert_array_equal(poses[index].R, reader.view(index)[1].R)
                np.testing.assert_array_equal(poses[index].t, reader.view(index)[1].t)


def test_searching_for_another_networks_descriptor_is_an_error(tmp_path: Path) -> None:
    with MapReader.open(make_map(tmp_path / "a.tpmap", 1)) as reader:
        for query in (np.zeros(31, np.float32), np.full(32, np.nan, np.float32)):
            with pytest.raises(DatabaseError, match="global descriptors are"):
                reader.search(query, 1)
        with pytest.raises(DatabaseError, match="no image 1 among 1"):
            reader.anchor(1)
        with pytest.raises(DatabaseError, match="no image -1 among 1"):
            reader.view(-1)


def test_readers_and_a_writer_of_one_process_share_the_map(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 2)
    with (
        MapReader.open(path) as first,
        MapWriter.open(path, MODEL) as writer,
        MapReader.open(path) as second,
    ):
        add(writer, 2)
        assert (first.refresh(), len(second)) == (False, 2)
        writer.commit()
        assert (first.refresh(), len(first), len(second)) == (True, 3, 2)
        assert first.verify() == second.verify() == []


def test_a_map_renamed_into_place_is_picked_up(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 2)
    with MapReader.open(path) as reader:
        make_map(tmp_path / "new.tpmap", 5).rename(path)
        assert len(reader) == 2
        require_image(reader, 1)
        assert reader.refresh() is True
        assert len(reader) == 5
        other = tmp_path / "other.tpmap"
        MapWriter.create(other, replace(MODEL, name="other")).close()
        other.rename(path)
        with pytest.raises(DatabaseError, match="made with model 'other'"):
            reader.refresh()
        require_image(reader, 4)


def test_opening_and_refreshing_leave_no_file_open(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 0)
    gc.collect()  # what other tests left open is not to be closed in between
    before = sorted(Path("/proc/self/fd").iterdir())
    with MapReader.open(path) as reader:
        for index in range(3):
            with MapWriter.open(path, MODEL) as writer:
                add(writer, index)
            assert (reader.refresh(), reader.refresh()) == (True, False)
    assert sorted(Path("/proc/self/fd").iterdir()) == before


def test_no_callback_runs_as_a_map_closes_in_which_ctrl_c_would_be_lost(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 0)
    with path.open("rb") as file:
        environment = share_environment(path, file.fileno())
        with MapReader.open(path):
            assert [known.__callback__ for known in getweakrefs(environment)] == [None]


def test_ctrl_c_as_a_map_closes_is_what_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = Snapshot.close

    def interrupted(snapshot: Snapshot) -> None:
        close(snapshot)
        raise KeyboardInterrupt

    path = make_map(tmp_path / "a.tpmap", 1)
    monkeypatch.setattr(Snapshot, "close", interrupted)
    with pytest.raises(KeyboardInterrupt), MapReader.open(path) as reader:
        reader.close()


def test_what_is_closed_says_so(tmp_path: Path) -> None:
    writer = MapWriter.create(tmp_path / "a.tpmap", MODEL)
    reader = MapReader.open(tmp_path / "a.tpmap")
    for closable in (reader, writer, reader, writer):
        closable.close()
    with pytest.raises(DatabaseError, match="this writer is closed"):
        add(writer, 0)
    with pytest.raises(DatabaseError, match=r"^[^:]*: this reader is closed"):
        reader.names()
