"""The experiments on posed images, in small: a corner of a rendered room."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.unit.conftest import Run
from tests.unit.layouts import View, write_cambridge
from tests.unit.posed_sets import write_set
from tests.unit.synthetic_rays import random_scene
from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import Localized
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel, find_model
from trigpoint.rigid import Rigid3
from trigpoint_db.build import read_frame
from trigpoint_db.experiments import ablation, anchors, averaging, noise
from trigpoint_db.experiments.sets import (
    choose,
    find_sets,
    fingerprint,
    identify,
    open_map,
    read_scenes,
    read_splits,
    read_wholes,
)
from trigpoint_db.experiments.store import read_result
from trigpoint_db.experiments.tables import median
from trigpoint_db.importers.base import Dataset

NUM_IMAGES = 12


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_set(folder / "corner", NUM_IMAGES)
    return folder


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all experiments, so that they share the maps."""
    return tmp_path_factory.mktemp("experiments")


def check_picture(path: Path) -> None:
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.std() > 5
    assert path.stat().st_size < 150_000


def test_averages_on_real_relative_poses(data: Path, output: Path, run: Run) -> None:
    code, out, _ = run("experiment", "averaging", "--data", data, "--output", output)
    assert code == 0
    result = read_result(output / "averaging.json")
    assert [row["set"] for row in result["rows"]] == ["corner", "corner, block"]
    for row in result["rows"]:
        assert row["num_averaged"] == row["num_queries"] == 2
        assert 0 < max(row["medians"].values()) < 0.05  # metres
    assert out.strip() == averaging.write_table(result)
    check_picture(output / "averaging.png")


def test_scenes_of_public_data_sets_are_read_from_their_folder(
    scene: tuple[Path, dict[str, View]], output: Path, run: Run
) -> None:
    assert list(read_scenes(scene[0].parent)) == list(read_scenes(scene[0])) == ["redkitchen"]
    command = "experiment", "averaging", "--root", scene[0].parent, "--output", output
    code, out, _ = run(*command, "--queries", 2, "--json")
    assert code == 0
    (row,) = json.loads(out)["rows"]
    assert (row["set"], row["num_mapped"], row["num_queries"]) == ("redkitchen", 3, 3)
    assert row["num_chosen"] == 2


def test_a_scene_of_the_papers_table_stands_beside_it(tmp_path: Path, run: Run) -> None:
    write_cambridge(tmp_path / "data" / "KingsCollege")
    command = "experiment", "averaging", "--root", tmp_path / "data", "--output", tmp_path
    code, out, _ = run(*command)
    assert code == 0
    (row,) = read_result(tmp_path / "averaging.json")["rows"]
    assert (row["set"], row["num_mapped"], row["num_queries"]) == ("KingsCollege", 3, 2)
    (kings,) = [line for line in out.splitlines() if line.startswith("| King's")]
    assert kings.startswith("| King's | 20 cm | 18 cm | ")
    assert "-" not in kings.split(" | ")[3:][0]


def test_more_anchors_step_by_step(data: Path, output: Path, run: Run) -> None:
    command = "experiment", "anchors", "--data", data, "--output", output, "--images", 1
    code, out, _ = run(*command)
    assert code == 0
    result = read_result(output / "anchors.json")
    rows = result["rows"]
    assert [row["num_anchors"] for row in rows] == [2, 3, 5, 10, NUM_IMAGES - 1]
    for before, after in itertools.pairwise(rows):
        assert after["ms"][anchors.RELATIVE_POSES] > before["ms"][anchors.RELATIVE_POSES]
    assert max(rows[-1]["medians"].values()) < 0.05
    assert out.strip() == anchors.write_table(result)
    check_picture(output / "anchors.png")


def test_a_gain_is_described_by_the_numbers() -> None:
    rows = [
        {"num_anchors": n, "medians": {"final": m}}
        for n, m in ((2, None), (20, 2.0), (50, 1.0), (100, 1.5))
    ]
    text = anchors.describe_gain(rows, "final")
    assert text == "least with 50 anchors; with 100 in place of 20 the median changes by -25 %."
    assert anchors.describe_gain(rows[:1], "final") == "no median."


def test_departures_are_taken_back_one_by_one(data: Path, output: Path, run: Run) -> None:
    command = "experiment", "ablation", "--data", data, "--output", output, "--queries", 1
    code, out, _ = run(*command)
    assert code == 0
    result = read_result(output / "ablation.json")
    assert result["variants"] == [label for label in ablation.VARIANTS if label != ablation.FLOAT]
    assert ablation.ratios(result, ablation.AS_IT_IS, "median") == [1.0, 1.0]
    for row in result["rows"]:
        assert {variant["num_lost"] for variant in row["variants"].values()} == {0}
    assert out.strip() == ablation.write_table(result)
    assert f"Not measured: {ablation.FLOAT}" in out
    check_picture(output / "ablation.png")


def test_a_network_in_float_is_one_more_variant(
    data: Path, output: Path, tmp_path: Path, run: Run
) -> None:
    command = "experiment", "ablation", "--data", data, "--output", output, "--queries", 1
    code, _, error = run(*command, "--fp32", tmp_path)
    assert code == 1
    assert f"{tmp_path}/base.fp32.onnx" in error
    shutil.copy(find_model("base"), tmp_path / "base.fp32.onnx")  # the same: it changes nothing
    code, out, _ = run(*command, "--fp32", tmp_path, "--json")
    assert code == 0
    result = json.loads(out)
    assert result["variants"] == list(ablation.VARIANTS)
    assert ablation.ratios(result, ablation.FLOAT, "median") == [1.0, 1.0]


def test_every_variant_is_another_localizer() -> None:
    kinds = {str(variant) for variant in ablation.VARIANTS.values()}
    assert len(kinds) == len(ablation.VARIANTS)


def test_the_paper_s_refinement_is_near_ours_and_not_the_same(
    data: Path, output: Path, model: FeatureModel
) -> None:
    name, dataset = next(iter(read_splits(data).items()))
    query = dataset.queries[0]
    frame = read_frame(dataset.images, query.name, query.camera)
    with open_map(output / "maps", name, dataset, model) as reader:
        plain, ours = (
            kind(model, reader).localize(frame) for kind in (ablation.PlainRefinement, Localizer)
        )
    assert isinstance(plain, Localized)
    assert isinstance(ours, Localized)
    distance = np.linalg.norm(plain.cam_from_world.center - ours.cam_from_world.center)
    assert 1e-9 < distance < 0.01


def test_each_method_gets_the_same_relative_poses() -> None:
    scene = random_scene(np.random.default_rng(0), 8)
    errors = averaging.center_errors(
        scene.anchors_from_world, scene.query_from_anchors, scene.query_from_world
    )
    assert errors is not None
    assert tuple(errors) == noise.METHODS
    assert max(errors.values()) < 1e-6
    one = np.zeros(1, dtype=np.intp)
    alone = scene.subset(one)
    assert (
        averaging.center_errors(
            alone.anchors_from_world, alone.query_from_anchors, alone.query_from_world
        )
        is None
    )


def test_a_map_is_kept_while_it_is_of_these_images(
    data: Path, tmp_path: Path, model: FeatureModel
) -> None:
    (whole,) = read_wholes(data).values()
    dataset = Dataset(whole.images, whole.mapped[:3])

    def build(dataset: Dataset) -> tuple[Path, int]:
        with open_map(tmp_path, "corner", dataset, model):
            (path,) = tmp_path.glob("*.tpmap")
            return path, path.stat().st_ino

    path, first = build(dataset)
    assert build(dataset) == (path, first)
    moved = [
        replace(image, cam_from_world=Rigid3(image.cam_from_world.R, image.cam_from_world.t + 1))
        for image in dataset.mapped
    ]
    build(Dataset(dataset.images, moved))
    with MapReader.open(path) as reader:
        np.testing.assert_allclose(reader.view(0)[1].t, moved[0].cam_from_world.t)


def test_a_choice_is_the_same_each_time_and_in_order() -> None:
    chosen = choose(range(100), 10)
    assert chosen == choose(range(100), 10) == sorted(chosen)
    assert len(set(chosen)) == 10
    assert choose("abc", 10) == ["a", "b", "c"]


@pytest.mark.parametrize("read", [find_sets, read_scenes])
def test_a_folder_without_sets_is_named(tmp_path: Path, read: Callable[[Path], object]) -> None:
    with pytest.raises(ConfigError, match=f"{tmp_path} holds no"):
        read(tmp_path)


def test_sets_without_splits_are_refused(data: Path, tmp_path: Path) -> None:
    (tmp_path / "corner").mkdir()
    (tmp_path / "corner" / "sparse").symlink_to(data / "corner" / "sparse")
    with pytest.raises(ConfigError, match=r"map\.txt and queries\.txt"):
        read_splits(tmp_path)


def test_there_must_be_something_to_measure_on(tmp_path: Path, run: Run) -> None:
    code, _, error = run("experiment", "averaging", "--output", tmp_path)
    assert (code, error) == (
        1,
        "trigpoint-db: there is nothing to measure on: give --data or --root",
    )


def test_a_percentile_is_that_of_the_ranks_beside_it() -> None:
    """Failures above them change nothing."""
    assert median([1.0, 2.0, None]) == 2.0
    assert median([3.0, None, 1.0, None, 2.0]) == 3.0
    assert median([*map(float, range(1, 11)), None], 90) == 10.0
    assert median([1.0, None]) is None


def test_a_run_of_other_data_or_of_another_network_begins_anew(
    data: Path, tmp_path: Path, model: FeatureModel
) -> None:
    sets = read_splits(data)
    dataset = sets["corner"]
    shift = Rigid3.from_center(np.eye(3), np.ones(3))
    truth = {name: pose @ shift for name, pose in dataset.truth.items()}
    moved = replace(dataset, truth=truth)
    focal = dataset.mapped[0].camera
    lens = replace(focal, params=(focal.params[0] + 1, *focal.params[1:]))
    other = replace(dataset, mapped=[replace(dataset.mapped[0], camera=lens), *dataset.mapped[1:]])
    known = {fingerprint(each) for each in (dataset, moved, other)}
    assert len(known) == 3
    assert identify(model, sets)["sha256"] == model.identity.sha256
    with open_map(tmp_path, "corner", dataset, model) as reader:
        assert reader.anchor(0).camera == focal
    with open_map(tmp_path, "corner", other, model) as reader:
        assert reader.anchor(0).camera == lens


def test_pictures_of_nothing_are_drawn(tmp_path: Path) -> None:
    row = {"set": "a", "num_averaged": 0, "medians": dict.fromkeys(noise.METHODS)}
    averaging.draw({"rows": [row]}, tmp_path / "averaging.png")
    assert (tmp_path / "averaging.png").is_file()
