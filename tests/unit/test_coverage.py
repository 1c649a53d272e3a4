"""Where a map is strong and where not, what lies between its images, and what to photograph."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.conftest import Demo
from tests.unit.conftest import Run
from tests.unit.maps import make_map
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.frame import LocalFeatures
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3, rotation_angle, rotation_from_vector
from trigpoint_db.coverage import (
    Coverage,
    Grade,
    Probe,
    horizontal_axes,
    mean_up,
    measure_coverage,
    view_distance,
)
from trigpoint_db.gaps import find_gaps, neighbor_pairs, suggest_poses
from trigpoint_db.ground import count_cells, headings
from trigpoint_db.poses import read_poses
from trigpoint_db.synthetic import look_along, look_at


def make_coverage(
    poses: Rigid3, grades: list[Grade], *, strong_reach: float = 0.5, reach: float = 0.7
) -> Coverage:
    """Each image was tried; all reach as far."""
    probes = [
        Probe(
            index=i,
            name=f"folder/{i}.png",
            cam_from_world=poses[i],
            grade=grade,
            outcome="LOCALIZED",
            num_left_out=0,
            num_anchors=8,
            depth=2.0,
            position_error=0.0,
            rotation_error_deg=0.0,
            position_std=0.0,
            stage_ms={},
            strong_reach=strong_reach,
            reach=reach,
        )
        for i, grade in enumerate(grades)
    ]
    return Coverage(tuple(probes), poses, 2.0, 0.2, np.array([0.0, 0.0, 1.0]))


def ring(degrees: NDArray[np.float64]) -> Rigid3:
    """Cameras around the origin at a distance of 2, looking at it."""
    angle = np.deg2rad(degrees)
    centers = 2 * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    return look_at(centers, np.zeros(3))


def test_view_distance_is_of_steps_over_depth_and_of_turns() -> None:
    here = look_along([0.0, 0.0, 0.0], 0.0, 0.0, 0.0)
    aside, turned = look_along([0.0, 0.5, 0.0], 0.0, 0.0, 0.0), look_along(np.zeros(3), 0.3, 0, 0)
    both = look_along([0.0, 0.5, 0.0], 0.3, 0.0, 0.0)
    assert view_distance(here, aside, 2.0) == pytest.approx(0.25)
    assert view_distance(here, turned, 2.0) == pytest.approx(0.3)
    assert view_distance(both, here, 2.0) == pytest.approx(np.hypot(0.25, 0.3))


def test_up_and_headings_are_those_of_upright_cameras_however_the_world_lies() -> None:
    yaw = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    poses = look_along(np.zeros((12, 3)), yaw, -0.2, 0.0)
    world = Rigid3(rotation_from_vector(np.array([0.7, -1.2, 0.4])), np.zeros(3))
    turned = poses @ world.inverse()
    up = mean_up(turned)
    np.testing.assert_allclose(up, world.R[:, 2], atol=1e-12)
    axes = horizontal_axes(up)
    np.testing.assert_allclose(
        np.vstack([axes, up]) @ np.vstack([axes, up]).T, np.eye(3), atol=1e-9
    )
    assert np.linalg.det(np.vstack([axes, up])) == pytest.approx(1)
    np.testing.assert_allclose(np.diff(np.unwrap(headings(turned, axes))), np.pi / 6)
    np.testing.assert_allclose(headings(poses, np.eye(3)[:2]) % (2 * np.pi), yaw, atol=1e-9)


def test_cameras_with_no_common_up_ask_for_it() -> None:
    R = rotation_from_vector(np.array([[0.0, 0, 0], [0, 0, np.pi]]))
    with pytest.raises(ConfigError, match="--up"):
        mean_up(Rigid3(R, np.zeros((2, 3))))


def test_neighbours_on_a_ring_are_those_beside_across_the_gap_too() -> None:
    degrees = np.array([0.0, 20, 40, 60, 80, 150, 170])
    centers = ring(degrees).center
    distances = np.linalg.norm(centers[:, None] - centers, axis=2)
    assert neighbor_pairs(distances) == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6)]


def test_gaps_are_found_between_images_and_graded_by_how_far_these_reach(tmp_path: Path) -> None:
    degrees = np.array([0.0, 10, 20, 30, 75, 85, 95])
    poses = ring(degrees)
    with MapReader.open(make_map(tmp_path / "m.tpmap", len(degrees))) as reader:  # for the names
        coverage = make_coverage(poses, [Grade.STRONG] * len(degrees))
        gaps = find_gaps(reader, coverage)
        assert {gap.reason.split(",")[0] for gap in gaps} == {
            "between folder/3.png and folder/4.png"
        }
        assert "45 degrees apart" in gaps[0].reason
        assert 0.3 < coverage.distance_to_images(gaps[1].cam_from_world) < 0.6
        for strong_reach, reach, grade in (
            (0.8, 0.9, Grade.STRONG),
            (0.25, 0.9, Grade.THIN),
            (0.25, 0.3, Grade.BLIND),
        ):
            poorer = make_coverage(
                poses, [Grade.STRONG] * len(degrees), strong_reach=strong_reach, reach=reach
            )
            middle = find_gaps(reader, poorer)[1]
            assert middle.grade is grade
            wanted = suggest_poses(poorer, find_gaps(reader, poorer), 10)
            assert (middle.grade is Grade.STRONG) == (not wanted)
    centers = np.array([gap.cam_from_world.center for gap in gaps])
    angle = np.rad2deg(np.arctan2(centers[:, 1], centers[:, 0]))
    assert ((angle > 30) & (angle < 75)).all()
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), 2.0)  # around what they look at


def test_images_that_were_not_compared_leave_no_gap_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    degrees = np.array([0.0, 45, 15, 60, 30])  # of those compared the first two are neighbours
    monkeypatch.setattr("trigpoint_db.gaps.MAX_COMPARED", 3)
    with MapReader.open(make_map(tmp_path / "m.tpmap", 5)) as reader:
        coverage = make_coverage(ring(degrees), [Grade.STRONG] * 5)
        assert find_gaps(reader, coverage) == []
        between = "between folder/0.png and folder/1.png"
        degrees[[2, 4]] = 75
        coverage = make_coverage(ring(degrees), [Grade.STRONG] * 5)
        assert {gap.reason.split(",")[0] for gap in find_gaps(reader, coverage)} == {between}


def test_the_way_between_cameras_that_look_apart_is_straight(tmp_path: Path) -> None:
    poses = look_along([[0.0, 0, 0], [0.0, 1.5, 0]], [-0.3, 0.3], 0.0, 0.0)
    with MapReader.open(make_map(tmp_path / "m.tpmap", 2)) as reader:
        gaps = find_gaps(reader, make_coverage(poses, [Grade.STRONG] * 2))
    assert len(gaps) > 1
    for gap in gaps:
        x, y, z = gap.cam_from_world.center
        assert (x, z) == pytest.approx((0, 0), abs=1e-9)
        assert 0 < y < 1.5
        assert headings(gap.cam_from_world, np.eye(3)[:2]) == pytest.approx(-0.3 + 0.4 * y)


def test_beside_weak_images_a_pose_is_wanted_that_looks_the_same_way() -> None:
    poses = ring(np.array([0.0, 10, 20]))
    coverage = make_coverage(poses, [Grade.THIN, Grade.STRONG, Grade.BLIND])
    wanted = suggest_poses(coverage, [], 10)
    assert [place.grade for place in wanted] == [Grade.BLIND, Grade.THIN]
    for place, index in zip(wanted, (2, 0), strict=True):
        assert f"folder/{index}.png" in place.reason
        assert rotation_angle(place.cam_from_world.R @ poses.R[index].T) < 1e-6
        step = np.linalg.norm(place.cam_from_world.center - poses.center[index])
        assert step == pytest.approx(0.2 * 2.0)
        assert coverage.distance_to_images(place.cam_from_world) > 0.1
    assert len(suggest_poses(coverage, [], 1)) == 1


def test_poses_wanted_are_apart() -> None:
    poses = ring(np.array([0.0, 0.5, 1.0]))
    wanted = suggest_poses(make_coverage(poses, [Grade.BLIND] * 3), [], 10)
    assert len(wanted) < 3


def test_cells_tell_places_and_headings_apart_and_take_the_middle_grade() -> None:
    yaw = np.array([0.0, 0.1, -0.1, np.pi / 2, 0.0])
    centers = np.array([[0.5, 0.5, 0]] * 4 + [[1.5, 0.5, 0]])
    grades = [Grade.STRONG, Grade.STRONG, Grade.BLIND, Grade.THIN, Grade.BLIND]
    coverage = make_coverage(look_along(centers, yaw, 0.0, 0.0), grades)
    assert [
        (c.column, c.row, c.sector, c.grade, c.num_images) for c in count_cells(coverage, 1)
    ] == [
        (0, 0, 0, Grade.STRONG, 3),
        (0, 0, 2, Grade.THIN, 1),
        (1, 0, 0, Grade.BLIND, 1),
    ]


@pytest.fixture(scope="module")
def weak_map(demo: Demo, model: FeatureModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's map; image 0 shows nothing that is anywhere else, image 1 stood elsewhere."""
    path = tmp_path_factory.mktemp("weak") / "weak.tpmap"
    rng = np.random.default_rng(0)
    with MapReader.open(demo.map) as reader, MapWriter.create(path, model.identity) as writer:
        for index in range(len(reader)):
            anchor, features = reader.anchor(index), reader.features(index)
            pose = anchor.cam_from_world
            if index == 0:
                features = _shuffled(features, rng)
            elif index == 1:
                pose = replace(pose, t=pose.t + np.array([0.0, 0.0, 0.5]))
            writer.add(anchor.name, anchor.camera, pose, features)
    return path


def _shuffled(features: LocalFeatures, rng: np.random.Generator) -> LocalFeatures:
    descriptors = rng.standard_normal(features.descriptors.shape)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return replace(features, descriptors=descriptors.astype(np.float32))


def test_images_that_nothing_supports_are_blind_and_others_strong(
    weak_map: Path, model: FeatureModel
) -> None:
    with MapReader.open(weak_map) as reader:
        coverage = measure_coverage(
            Localizer(model, reader), num_probes=140, track=lambda indices: [*indices[:2], 30, 60]
        )
    unknown, moved, *others = coverage.probes
    assert (unknown.grade, moved.grade) == (Grade.BLIND, Grade.BLIND)
    assert moved.outcome == "WRONG_POSE"
    assert moved.position_error == pytest.approx(0.5, abs=0.05)
    assert unknown.reach == moved.reach == 0
    for probe in others:
        assert probe.grade is not Grade.BLIND
        assert probe.position_error < 0.05
        assert probe.reach >= probe.strong_reach
        assert probe.reach > coverage.apart
    assert 1.0 < coverage.median_depth < 5.0
    np.testing.assert_allclose(coverage.up, [0, 0, 1], atol=0.1)


def test_coverage_prints_draws_and_lists_poses(
    run: Run, weak_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture, poses = tmp_path / "coverage.png", tmp_path / "poses.txt"
    asked = ["coverage", weak_map, "--probes", 2, "-o", picture, "--photograph", poses]
    code, said, _ = run(*asked, "--json")
    assert code == 0
    facts = json.loads(said)
    assert sum(facts["counts"].values()) == 2
    assert facts["images"][0]["grade"] == "blind"
    assert picture.read_bytes().startswith(b"\x89PNG")
    named = read_poses(poses)
    assert len(named) == len(facts["photograph"]) > 0
    first = facts["photograph"][0]
    np.testing.assert_allclose(named["photograph_000"].center, first["center"])
    (tmp_path / "a[").mkdir()
    bracketed = tmp_path / "a[" / "b].tpmap"
    bracketed.write_bytes(weak_map.read_bytes())
    monkeypatch.chdir(tmp_path)
    code, said, _ = run("coverage", bracketed.relative_to(tmp_path), "--probes", 1)
    assert code == 0
    assert "a[/b].tpmap: 1 of" in said
    assert "photograph (" in said


def test_a_direction_up_that_is_none_and_a_small_map_are_errors(
    run: Run, weak_map: Path, model: FeatureModel, tmp_path: Path
) -> None:
    code, _, said = run("coverage", weak_map, "--up", "0,0")
    assert (code, "--up wants a direction" in said) == (1, True)
    code, _, said = run("coverage", weak_map, "--cell", "inf")
    assert (code, "--cell wants a length, not inf" in said) == (1, True)
    code, _, said = run("coverage", weak_map, "-o", tmp_path / "x.txt")
    assert (code, "cannot draw" in said) == (1, True)
    both = tmp_path / "x.png"
    code, _, said = run("coverage", weak_map, "-o", both, "--photograph", both)
    assert (code, "it is named twice" in said) == (1, True)
    MapWriter.create(tmp_path / "empty.tpmap", model.identity).close()
    code, _, said = run("coverage", tmp_path / "empty.tpmap")
    assert (code, "three at least" in said) == (1, True)


def test_without_matplotlib_a_picture_is_refused_before_the_work(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    code, _, said = run("coverage", tmp_path / "missing.tpmap", "-o", tmp_path / "x.png")
    assert (code, "pip install 'trigpoint[plots]'" in said) == (1, True)
