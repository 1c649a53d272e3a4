"""Retrieval is judged by what images see, and what is said of it follows from the numbers."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit import graphs
from tests.unit.layouts import KINECT, take
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
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.visibility import find_overlapping
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.synthetic import look_along

# A query in a corner of the room, and images beside it, turned round, and looking back at it.
QUERY = look_along([-1.0, -1.0, 1.3], 0.7, -0.1, 0.0)
BESIDE = look_along([-0.7, -1.2, 1.2], 0.75, -0.1, 0.0)
FURTHER = look_along([-1.2, -0.6, 1.4], 0.6, -0.1, 0.0)
BEHIND = look_along([-1.0, -1.0, 1.3], 0.7 + np.pi, -0.1, 0.0)
OPPOSITE = look_along([1.5, 1.2, 1.3], 0.7 + np.pi, -0.1, 0.0)


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
    fields = {
        "kind": "retrieval", "name": "places", "global_dim": graphs.NUM_GLOBAL,
        "channels": 3, "normalization": "imagenet", "height": 320, "width": 320,
        "names": {"image": "img", "global": "des"},
    }  # fmt: skip
    source = graphs.eigenplaces_like(folder / "plain.onnx")
    adapt_model(source, folder / "places.onnx", fields)
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


@pytest.mark.parametrize(
    ("share", "possible", "mostly", "lacks"),
    [(0.3, 0.35, "0 of 1 sets (none)", "mostly not in the map"),
     (0.6, 0.95, "1 of 1 sets (a)", "mostly not found")],
)  # fmt: skip
def test_what_is_said_of_the_paper_follows_from_the_numbers(
    share: float, possible: float, mostly: str, lacks: str
) -> None:
    methods = {
        POSSIBLE: {"recalls": [1.0] * 4, "share": possible, "histogram": [1] * 10},
        PACKAGED: {"recalls": [0.5] * 4, "share": share, "histogram": [1] * 10},
        TINY: {"recalls": [0.75] * 4, "share": 0.1, "histogram": [1] * 10},
        CHANCE: {"recalls": [0.1] * 4, "share": 0.1},
    }
    measured = {"num_mapped": 40, "num_queries": 10, "methods": methods}
    table = recall.write_table(
        {"model": "x", "num_anchors": 20, "num_queries": 9, "sets": {"a": measured}}
    )
    assert f"more than half are correct in {mostly}" in table
    assert f"what lacks is {lacks}" in table
    assert f"{TINY} 75.0 and 10.0; {PACKAGED} 50.0 and {100 * share:.1f}" in table


def test_images_are_ranked_by_likeness_and_apart_from_those_before_where_asked() -> None:
    images = np.array([[0.6, 0.8], [1, 0], [0.99, 0.14], [0, 1]], np.float32)
    query = np.array([[0.95, 0.31]], np.float32)
    np.testing.assert_array_equal(recall._rank(query, images, 3), [[2, 1, 0]])
    np.testing.assert_array_equal(recall._rank(query, images, 3, 0.8), [[2, 0, 1]])


def test_chance_is_that_of_drawing_without_returning() -> None:
    is_correct = np.zeros((1, 4), np.bool_)
    is_correct[0, :2] = True
    chance = recall._describe_chance(is_correct)
    assert chance["recalls"] == pytest.approx([0.5, 1, 1, 1])
    assert chance["share"] == 0.5
