"""Every format, written from a rendered room, comes back with the room's own cameras and poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from tests.unit.layouts import (
    View,
    check_truth,
    write_cambridge,
    write_pseudo_truth,
    write_robotcar,
)
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset, PosedImage
from trigpoint_db.importers.colmap import write_model
from trigpoint_db.importers.registry import find_format, read_dataset
from trigpoint_db.poses import write_poses, write_queries


def check(dataset: Dataset, views: Mapping[str, View], mapped: set[str], tested: set[str]) -> None:
    assert {image.name for image in dataset.mapped} == mapped
    assert {query.name for query in dataset.queries} == tested
    check_truth(dataset.mapped, views)
    cameras = {query.name: query.camera for query in dataset.queries}
    truth = [PosedImage(name, cameras[name], pose) for name, pose in dataset.truth.items()]
    check_truth([*dataset.mapped, *truth], views)
    for name in (*mapped, *tested):
        assert (dataset.images / name).is_file()


def test_seven_scenes_has_the_poses_of_the_colour_camera(
    scene: tuple[Path, dict[str, View]],
) -> None:
    root, views = scene
    assert find_format(root) == "7scenes"
    tested = {name for name in views if name.startswith("seq-03")}
    check(read_dataset(root), views, set(views) - tested, tested)


def test_seven_scenes_with_poses_by_structure_from_motion(
    scene: tuple[Path, dict[str, View]], tmp_path: Path
) -> None:
    root, _ = scene
    names = sorted(path.relative_to(root).as_posix() for path in root.glob("*/*.color.png"))
    views = write_pseudo_truth(tmp_path / "sfm", "redkitchen", names)
    dataset = read_dataset(root, poses=tmp_path / "sfm")
    check(dataset, views, set(names[:3]), set(names[3:]))


def test_cambridge_has_lenses_of_visual_sfm_and_no_outliers(tmp_path: Path) -> None:
    views = write_cambridge(tmp_path)
    assert find_format(tmp_path) == "cambridge"
    names = list(views)
    check(read_dataset(tmp_path), views, set(names[:3]), set(names[3:]))


def test_aachen_by_its_nvm_file(town: tuple[Path, dict[str, View]]) -> None:
    root, views = town
    assert find_format(root) == "aachen"
    names = list(views)
    dataset = read_dataset(root)
    check(dataset, views, set(names[:3]), set(names[3:]))
    assert [query.camera.params for query in dataset.queries] == [
        pytest.approx(views[query.name].camera.params) for query in dataset.queries
    ]
    assert dataset.truth == {}


def test_aachen_by_its_colmap_model_with_images_a_folder_deeper(
    town: tuple[Path, dict[str, View]], town_copy: Path
) -> None:
    views, names, model = town[1], list(town[1]), town_copy / "3D-models" / "aachen_v_1_1"
    (model / "aachen_v_1_1.nvm").unlink()
    write_model(model, [PosedImage(n, views[n].camera, views[n].cam_from_world) for n in names[:3]])
    (town_copy / "images").mkdir()
    (town_copy / "images_upright").rename(town_copy / "images" / "images_upright")
    check(read_dataset(town_copy), views, set(names[:3]), set(names[3:]))


def test_robotcar_has_the_rear_camera_of_all_conditions(tmp_path: Path) -> None:
    views = write_robotcar(tmp_path)
    assert find_format(tmp_path) == "robotcar"
    names = list(views)
    dataset = read_dataset(tmp_path)
    check(dataset, views, set(names[:2]), set(names[2:]))
    assert set(dataset.truth) == {names[2]}


def test_lists_of_hloc_are_queries_where_they_have_no_pose(
    town: tuple[Path, dict[str, View]], tmp_path: Path
) -> None:
    root, views = town
    queries = read_dataset(root).queries
    write_queries(tmp_path / "list.txt", queries)
    names = [query.name for query in queries]
    write_poses(tmp_path / "poses.txt", {name: views[name].cam_from_world for name in names[:2]})
    (tmp_path / "images").symlink_to(root / "images_upright")
    dataset = read_dataset(tmp_path / "list.txt", poses=tmp_path / "poses.txt")
    check(dataset, views, set(names[:2]), set(names[2:]))


def test_colmap_models_are_found_with_their_images(
    town: tuple[Path, dict[str, View]], tmp_path: Path
) -> None:
    root, views = town
    mapped = read_dataset(root).mapped
    write_model(tmp_path / "sparse" / "0", mapped)
    names = {image.name for image in mapped}
    with pytest.raises(ConfigError, match=r"there is no folder .*images; say where .*--images"):
        read_dataset(tmp_path)
    check(read_dataset(tmp_path, images=root / "images_upright"), views, names, set())
    (tmp_path / "images").symlink_to(root / "images_upright")
    check(read_dataset(tmp_path), views, names, set())


MISTAKES: dict[str, Callable[[PosedImage], PosedImage]] = {
    "half a pixel": lambda i: PosedImage(i.name, i.camera.shifted(0.5), i.cam_from_world),
    "a pose from camera to world": lambda i: PosedImage(
        i.name, i.camera, i.cam_from_world.inverse()
    ),
    "y up and z back": lambda i: PosedImage(
        i.name, i.camera, Rigid3(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ i.cam_from_world
    ),
    "a quaternion that ends with w": lambda i: PosedImage(
        i.name,
        i.camera,
        Rigid3.from_quaternion(np.roll(i.cam_from_world.quaternion, 1), i.cam_from_world.t),
    ),
    "a position for a translation": lambda i: PosedImage(
        i.name, i.camera, Rigid3(i.cam_from_world.R, i.cam_from_world.center)
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_check_of_these_tests_notices(mistake: str, town: tuple[Path, dict[str, View]]) -> None:
    root, views = town
    images = read_dataset(root).mapped
    check_truth(images, views)
    with pytest.raises(AssertionError):
        check_truth([MISTAKES[mistake](image) for image in images], views)
