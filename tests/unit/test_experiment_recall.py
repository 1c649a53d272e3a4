"""Retrieval is judged by what images see, and what is said of it follows from the numbers."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit import graphs
from tests.unit.conftest import Run
from tests.unit.layouts import KINECT, take
from tests.unit.posed_sets import write_set
from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import Anchor, quantize_descriptors
from trigpoint.models.features import FeatureModel
from trigpoint.models.retrieval import RetrievalModel
from trigpoint.rigid import Rigid3
from trigpoint_db.adapt import adapt_model
from trigpoint_db.build import build_map, read_frame
from trigpoint_db.experiments import recall
from trigpoint_db.experiments.page import shrink
from trigpoint_db.experiments.recall import CHANCE, DIVERSE, PACKAGED, POSSIBLE, ROOM, TINY
from trigpoint_db.experiments.sets import choose
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.visibility import find_overlapping
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.synthetic import flight_poses, look_along, make_room

# A query in a corner of the room, and images beside it, turned round, and looking back at it.
QUERY = look_along([-1.0, -1.0, 1.3], 0.7, -0.1, 0.0)
BESIDE = look_along([-0.7, -1.2, 1.2], 0.75, -0.1, 0.0)
FURTHER = look_along([-1.2, -0.6, 1.4], 0.6, -0.1, 0.0)
BEHIND = look_along([-1.0, -1.0, 1.3], 0.7 + np.pi, -0.1, 0.0)
OPPOSITE = look_along([1.5, 1.2, 1.3], 0.7 + np.pi, -0.1, 0.0)
PLACES: dict[str, Any] = {
    "kind": "retrieval", "name": "places", "global_dim": graphs.NUM_GLOBAL,
    "channels": 3, "normalization": "imagenet", "height": 320, "width": 320,
    "names": {"image": "img", "global": "des"},
}  # fmt: skip


@pytest.fixture(scope="session")
def tiny() -> FeatureModel:
    return FeatureModel.load("tiny")


def make_query(folder: Path, model: FeatureModel, cam_from_world: Rigid3) -> Anchor:
    image = read_frame(folder, "query.png", KINECT).image
    features = model.extract(image)
    codes = quantize_descriptors(features.descriptors)
    return Anchor("query.png", KINECT, cam_from_world, features.keypoints, codes)


def make_map(folder: Path, model: FeatureModel, poses: list[Rigid3]) -> Path:
    images = [PosedImage(f"{i}.png", KINECT, pose) for i, pose in enumerate(poses)]
    for image in images:
        take(folder / image.name, KINECT, image.cam_from_world)
    build_map(folder / "m.tpmap", images, folder, model)
    return folder / "m.tpmap"


def test_images_are_correct_that_see_the_same_from_about_the_same_side(
    tiny: FeatureModel, tmp_path: Path
) -> None:
    take(tmp_path / "query.png", KINECT, QUERY)
    path = make_map(tmp_path, tiny, [BESIDE, BEHIND, FURTHER, OPPOSITE])
    with MapReader.open(path, tiny.identity) as reader:
        query = make_query(tmp_path, tiny, QUERY)
        found = find_overlapping([query], reader, tiny.long_side_px)
    np.testing.assert_array_equal(found, [[True, False, True, False]])


def test_poses_by_which_nothing_is_shared_are_an_error(tiny: FeatureModel, tmp_path: Path) -> None:
    take(tmp_path / "query.png", KINECT, QUERY)
    path = make_map(tmp_path, tiny, [BEHIND, OPPOSITE])
    with MapReader.open(path, tiny.identity) as reader:
        query = make_query(tmp_path, tiny, QUERY)
        with pytest.raises(ConfigError, match="are the poses right"):
            find_overlapping([query], reader, tiny.long_side_px)


def test_tiny_images_do_not_depend_on_exposure() -> None:
    image = np.random.default_rng(0).integers(0, 100, (48, 64), np.uint8)
    described = recall.describe_tiny(image)
    assert np.linalg.norm(described) == pytest.approx(1)
    brighter = recall.describe_tiny((2 * image + 10).astype(np.uint8))
    assert described @ brighter == pytest.approx(1, abs=1e-3)
    assert np.isfinite(recall.describe_tiny(np.full((48, 64), 7, np.uint8))).all()


@pytest.fixture(scope="session")
def measured(
    tiny: FeatureModel, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("recall")
    source = graphs.eigenplaces_like(folder / "plain.onnx")
    adapt_model(source, folder / "places.onnx", PLACES)
    external = RetrievalModel.load(folder / "places.onnx")
    store = Store(folder)
    result = recall.measure({}, tiny, external, 20, 100, store, num_survey=24, num_flight=2)
    return result, store.write("recall", result)


def test_descriptors_are_compared_in_a_rendered_room(
    measured: tuple[dict[str, Any], Path],
) -> None:
    methods = measured[0]["sets"][ROOM]["methods"]
    assert list(methods) == [POSSIBLE, PACKAGED, DIVERSE, "places", TINY, CHANCE]
    best, chance = methods[POSSIBLE], methods[CHANCE]
    for found in methods.values():
        assert found["recalls"] == sorted(found["recalls"])
        assert found["share"] <= best["share"]
    assert methods[PACKAGED]["recalls"][0] > chance["recalls"][0]
    assert sum(methods[PACKAGED]["histogram"]) == 2


def test_the_table_has_all_methods_and_the_picture_is_small(
    measured: tuple[dict[str, Any], Path],
) -> None:
    result, path = measured
    table = recall.write_table(result)
    for method in result["sets"][ROOM]["methods"]:
        assert f"| {method} |" in table
    if find_spec("matplotlib") is None:
        pytest.skip("needs trigpoint[plots]")
    picture = path.with_suffix(".png")
    recall.draw(result, picture)
    shrink(picture)
    assert 0 < picture.stat().st_size < 150_000


def made_up(share: float, possible: float) -> dict[str, Any]:
    methods = {
        POSSIBLE: {"recalls": [1.0] * 4, "share": possible, "histogram": [1] * 10},
        PACKAGED: {"recalls": [0.5] * 4, "share": share, "histogram": [1] * 10},
        TINY: {"recalls": [0.75] * 4, "share": 0.1, "histogram": [1] * 10},
        CHANCE: {"recalls": [0.1] * 4, "share": 0.1},
    }
    return {"num_mapped": 40, "num_queries": 10, "methods": methods}


def write_sets(sets: dict[str, Any]) -> str:
    return recall.write_table({"model": "x", "num_anchors": 20, "num_queries": 9, "sets": sets})


def test_the_rendered_room_has_no_say_beside_real_images() -> None:
    real, room = made_up(0.783, 0.87), made_up(0.6, 1.0)
    table = write_sets({"a": real, ROOM: room})
    assert "8.7 % lack a correct image that the map has, and 13.0 % one" in table
    assert "what lacks is mostly not in the map" in table
    assert "more than half are correct in 1 of 1 sets (a)" in table
    assert "Over all queries of real images, the first image is correct" in table
    assert f"{TINY} 75.0 and 10.0; {PACKAGED} 50.0 and 78.3." in table
    assert "what lacks is mostly not found" in write_sets({ROOM: room})


def test_where_hardly_anything_lacks_nothing_is_said_of_it() -> None:
    assert "what lacks" not in write_sets({"a": made_up(0.992, 0.996)})
    assert "what lacks" in write_sets({"a": made_up(0.97, 0.996)})


@pytest.mark.parametrize(
    ("share", "possible", "mostly", "lacks"),
    [(0.3, 0.35, "0 of 1 sets (none)", ("5.0", "65.0", "not in the map")),
     (0.6, 0.95, "1 of 1 sets (a)", ("35.0", "5.0", "not found"))],
)  # fmt: skip
def test_what_is_said_of_the_paper_follows_from_the_numbers(
    share: float, possible: float, mostly: str, lacks: tuple[str, str, str]
) -> None:
    table = write_sets({"a": made_up(share, possible)})
    assert f"more than half are correct in {mostly}" in table
    not_found, not_mapped, missing = lacks
    assert f"{not_found} % lack a correct image that the map has, and {not_mapped} % one" in table
    assert f"what lacks is mostly {missing}." in table
    assert f"{TINY} 75.0 and 10.0; {PACKAGED} 50.0 and {100 * share:.1f}" in table


def test_images_are_ranked_by_likeness_and_apart_from_those_before_where_asked() -> None:
    images = np.array([[0.6, 0.8], [1, 0], [0.99, 0.14], [0, 1]], np.float32)
    query = np.array([[0.95, 0.31]], np.float32)
    np.testing.assert_array_equal(recall._rank(query, images, 3), [[2, 1, 0]])
    np.testing.assert_array_equal(recall._rank(query, images, 3, 0.8), [[2, 0, 1]])


def test_chance_is_that_of_drawing_without_returning() -> None:
    is_correct = np.zeros((1, 4), np.bool_)
    is_correct[0, :2] = True
    chance = recall._describe_chance(is_correct, 20)
    assert chance["recalls"] == pytest.approx([0.5, 1, 1, 1])
    assert chance["share"] == 0.5


def test_ranks_are_those_of_the_images_that_are_retrieved() -> None:
    is_correct = np.ones((1, 40), np.bool_)
    assert len(recall._describe_chance(is_correct, 7)["recalls"]) == 2
    assert len(recall._describe_best(is_correct, 7)["recalls"]) == 2
    assert len(recall._describe_best(is_correct, 20)["recalls"]) == 4
    measured = made_up(0.6, 0.9)
    for found in measured["methods"].values():
        del found["recalls"][2:]
    result = {"model": "x", "num_anchors": 7, "num_queries": 9, "sets": {"a": measured}}
    assert "| top 1 | top 5 | correct of 7 |" in recall.write_table(result)


def test_the_query_drawn_is_the_one_that_was_asked(tiny: FeatureModel, tmp_path: Path) -> None:
    store = Store(tmp_path)
    result = recall.measure({}, tiny, None, 5, 1, store, num_survey=12, num_flight=4)
    [chosen] = choose(range(4), 1)
    assert chosen > 0
    shown = result["sets"][ROOM]["shown"]
    assert (shown["query"], shown["of"]) == (chosen, 4)
    world = make_room(recall.ROOM_SEED)
    drawn = recall._find_shown(world, result["sets"][ROOM])
    np.testing.assert_array_equal(drawn.t, flight_poses(world, 4, recall.ROOM_SEED)[chosen].t)


def test_another_network_of_the_same_name_is_measured_anew(
    measured: tuple[dict[str, Any], Path], tiny: FeatureModel, tmp_path: Path
) -> None:
    source = graphs.eigenplaces_like(tmp_path / "plain.onnx")
    adapt_model(source, tmp_path / "places.onnx", PLACES | {"normalization": "unit"})
    settings = []
    for path in (measured[1].parent / "places.onnx", tmp_path / "places.onnx"):
        external = RetrievalModel.load(path)
        assert external.contract.name == "places"
        store = Store(tmp_path)
        recall.measure({}, tiny, external, 5, 1, store, num_survey=12, num_flight=2)
        settings.append((tmp_path / "recall.jsonl").read_text().splitlines()[0])
    assert settings[0] != settings[1]


def test_sets_without_stretches_of_queries_are_named(tmp_path: Path, run: Run) -> None:
    folder = write_set(tmp_path / "corner", 10)
    (folder / "queries_block.txt").unlink()
    code, _, error = run("experiment", "recall", "--data", tmp_path, "--output", tmp_path / "out")
    assert code == 1
    assert f"no set in {tmp_path} has map_block.txt and queries_block.txt" in error
