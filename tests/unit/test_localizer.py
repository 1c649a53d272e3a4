"""The pipeline on the rendered room: what is found, what is refused, and why."""

import itertools
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.conftest import Demo
from tests.unit.scenes import generator
from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import new_map
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.frame import Frame, Localized, Lost, Prior, Reason, Session, describe
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint.stages import average_poses
from trigpoint_db.demo import BODY_FROM_CAMERA, CAMERA
from trigpoint_db.poses import read_poses


@pytest.fixture(scope="module")
def reader(demo: Demo, model: FeatureModel) -> Iterator[MapReader]:
    with MapReader.open(demo.map, model.identity) as opened:
        yield opened


@pytest.fixture(scope="module")
def flight(demo: Demo) -> list[tuple[Frame, Rigid3]]:
    """Some frames with their true cam_from_world."""
    truth = list(read_poses(demo.truth).values())
    paths = sorted((demo.folder / "flight").glob("*.jpg"))
    return [
        (Frame(read_gray(paths[i]), CAMERA), BODY_FROM_CAMERA.inverse() @ truth[i])
        for i in (0, 5, 10)
    ]


@pytest.mark.parametrize("generator_name", ["best", "anchor_pairs", "latent_points"])
def test_frames_are_localized_by_either_generator(
    model: FeatureModel,
    reader: MapReader,
    flight: list[tuple[Frame, Rigid3]],
    generator_name: str,
) -> None:
    options = LocalizerOptions(generator=generator_name)  # type: ignore[arg-type]
    localizer = Localizer(model, reader, options)
    for frame, truth in flight:
        result = localizer.localize(frame)
        assert isinstance(result, Localized), describe(result)
        assert np.linalg.norm(result.cam_from_world.center - truth.center) < 0.02
        assert np.degrees(rotation_angle(result.cam_from_world.R @ truth.R.T)) < 0.3
        assert np.linalg.eigvalsh(result.covariance)[0] > 0
        if generator_name != "best":
            assert result.statistics.generator == generator_name
        assert (result.statistics.num_consistent_anchors >= 2) == (generator_name == "anchor_pairs")


def test_a_pose_names_the_points_and_anchors_it_rests_on(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    options = LocalizerOptions()
    result = Localizer(model, reader, options).localize(flight[0][0])
    assert isinstance(result, Localized)
    support, statistics = result.support, result.statistics
    assert len(support.inliers) == statistics.num_points
    assert support.inliers.sum() == statistics.num_inliers
    points_cam = result.cam_from_world.apply(support.points3d)
    errors = np.linalg.norm(points_cam[:, :2] / points_cam[:, 2:] - support.points2d, axis=1)
    limit = options.max_reprojection_error_px / CAMERA.focal_px
    np.testing.assert_array_equal(errors < limit, support.inliers)

    names = {reader.anchor(i).name: reader.anchor(i) for i in range(len(reader))}
    expected = np.array([names[name].cam_from_world.t for name in statistics.anchors])
    np.testing.assert_array_equal(support.anchors_from_world.t, expected)


def test_a_refused_pose_names_them_too(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    options = LocalizerOptions(max_position_std_m=2e-6)
    result = Localizer(model, reader, options).localize(flight[0][0])
    assert isinstance(result, Lost)
    assert result.reason is Reason.HIGH_UNCERTAINTY
    assert result.support is not None
    assert result.support.inliers.sum() == result.statistics.num_inliers


def test_the_same_frame_gives_the_same_pose(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    first, second = (Localizer(model, reader).localize(flight[0][0]) for _ in range(2))
    assert isinstance(first, Localized)
    assert isinstance(second, Localized)
    np.testing.assert_array_equal(first.cam_from_world.t, second.cam_from_world.t)
    np.testing.assert_array_equal(first.covariance, second.covariance)


def test_stage_times_are_measured_with_the_callers_clock(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    ticks = iter(range(1000))
    result = Localizer(model, reader, clock=lambda: float(next(ticks))).localize(flight[0][0])
    assert set(result.statistics.stage_ms.values()) == {1000.0}
    assert list(result.statistics.stage_ms)[:3] == ["features", "retrieval", "matching"]
    untimed = Localizer(model, reader).localize(flight[0][0])
    assert untimed.statistics.stage_ms == {}


def num_anchors(
    model: FeatureModel, reader: MapReader, frame: Frame, seconds_a_tick: float, **changes: float
) -> int:
    """How many anchors a frame takes, by a clock that ticks each time it is read."""
    ticks = itertools.count()
    options = LocalizerOptions(**changes)  # type: ignore[arg-type]
    localizer = Localizer(model, reader, options, lambda: next(ticks) * seconds_a_tick)
    result = localizer.localize(frame)
    assert isinstance(result, Localized), describe(result)
    assert len(result.statistics.anchors) == result.statistics.num_anchors
    return result.statistics.num_anchors


def test_anchors_are_added_until_the_pose_is_certain_or_the_time_is_up(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    frame = flight[0][0]
    assert num_anchors(model, reader, frame, 0.001) == 6
    assert num_anchors(model, reader, frame, 0.001, first_anchors=20) == 20
    never: dict[str, float] = {"enough_position_std_ratio": 2e-6}
    assert num_anchors(model, reader, frame, 0.001, **never) == 20
    assert num_anchors(model, reader, frame, 0.001, max_latency_ms=1000, **never) == 20
    assert num_anchors(model, reader, frame, 0.001, max_latency_ms=20, **never) == 6
    assert num_anchors(model, reader, frame, 10.0, max_latency_ms=1, **never) == 6


def test_the_inliers_of_each_anchor_are_counted(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    for frame, _ in flight:
        statistics = Localizer(model, reader).localize(frame).statistics
        assert len(statistics.anchor_inliers) == len(statistics.anchors)
        # Each inlier is seen by two anchors at least, and of an anchor at most all of them.
        assert sum(statistics.anchor_inliers) >= 2 * statistics.num_inliers
        assert max(statistics.anchor_inliers) <= statistics.num_inliers
        num_used = sum(count > 0 for count in statistics.anchor_inliers)
        assert 2 <= num_used <= LocalizerOptions().num_refined_anchors


@pytest.fixture(scope="module")
def two_sessions(
    reader: MapReader, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MapReader]:
    """The room's map with every other image of another session."""
    path = tmp_path_factory.mktemp("sessions") / "m.tpmap"
    with new_map(path, reader.model) as writer:
        for index in range(len(reader)):
            session = Session("even" if index % 2 == 0 else "odd")
            record = replace(reader.record(index), session=session)
            writer.add_record(record, record.name)
    with MapReader.open(path) as opened:
        yield opened


def shares_of_even(model: FeatureModel, reader: MapReader, frame: Frame, **asked: Any) -> float:
    """What share of the anchors of a localized frame are of the session `even`."""
    options = LocalizerOptions(first_anchors=20, **asked)
    result = Localizer(model, reader, options).localize(frame)
    assert isinstance(result, Localized)
    names = reader.names()
    is_even = [names.index(name) % 2 == 0 for name in result.statistics.anchors]
    return sum(is_even) / len(is_even)


def test_anchors_of_sessions_are_preferred_and_excluded(
    model: FeatureModel, two_sessions: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    for frame, _ in flight:
        share = partial(shares_of_even, model, two_sessions, frame)
        assert share(exclude_sessions=("odd",)) == 1
        assert share(exclude_sessions=("even",)) == 0
        assert share(prefer_sessions=("odd",)) < share() < share(prefer_sessions=("even",))


def test_a_map_of_which_everything_is_excluded_has_too_few_anchors(
    model: FeatureModel, two_sessions: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    options = LocalizerOptions(exclude_sessions=("even", "odd"))
    result = Localizer(model, two_sessions, options).localize(flight[0][0])
    assert reason(result) is Reason.FEW_ANCHORS


def test_a_session_is_not_both_preferred_and_excluded() -> None:
    with pytest.raises(ConfigError, match="'old' is in prefer_sessions and in exclude_sessions"):
        LocalizerOptions(prefer_sessions=("old",), exclude_sessions=("new", "old"))


def reason(result: object) -> Reason:
    assert isinstance(result, Lost)
    return result.reason


def test_a_black_frame_is_too_dark(model: FeatureModel, reader: MapReader) -> None:
    black = Frame(np.zeros((480, 640), np.uint8), CAMERA)
    assert reason(Localizer(model, reader).localize(black)) is Reason.TOO_DARK


def test_a_frame_with_three_spots_has_too_few_features(
    model: FeatureModel, reader: MapReader
) -> None:
    image = np.full((480, 640), 100, np.uint8)
    for x in (160, 320, 480):
        cv2.circle(image, (x, 240), 6, 200, -1)
    spots = Frame(np.asarray(cv2.GaussianBlur(image, (0, 0), 2), np.uint8), CAMERA)
    result = Localizer(model, reader).localize(spots)
    assert reason(result) is Reason.FEW_FEATURES
    assert 3 <= result.statistics.num_features < 50


def test_noise_is_not_a_place(model: FeatureModel, reader: MapReader) -> None:
    noise = generator("noise").integers(0, 255, (480, 640)).astype(np.uint8)
    result = Localizer(model, reader).localize(Frame(noise, CAMERA))
    assert reason(result) in (
        Reason.FEW_MATCHES,
        Reason.FEW_INLIERS,
        Reason.FEW_ANCHORS,
        Reason.LOW_CONFIDENCE,
    )


def test_an_empty_map_is_no_map(
    model: FeatureModel, flight: list[tuple[Frame, Rigid3]], tmp_path: Path
) -> None:
    with MapWriter.create(tmp_path / "empty.tpmap", model.identity):
        pass
    with MapReader.open(tmp_path / "empty.tpmap", model.identity) as empty:
        assert reason(Localizer(model, empty).localize(flight[0][0])) is Reason.NO_MAP


def test_one_anchor_is_too_few(
    model: FeatureModel, flight: list[tuple[Frame, Rigid3]], tmp_path: Path
) -> None:
    frame, truth = flight[0]
    with MapWriter.create(tmp_path / "one.tpmap", model.identity) as writer:
        writer.add("one", CAMERA, truth, model.extract(frame.image))
    with MapReader.open(tmp_path / "one.tpmap", model.identity) as one:
        assert reason(Localizer(model, one).localize(frame)) is Reason.FEW_ANCHORS


def test_an_uncertain_position_is_refused_where_a_limit_is_set(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    options = LocalizerOptions(max_position_std_m=1e-5)
    result = Localizer(model, reader, options).localize(flight[0][0])
    assert reason(result) is Reason.HIGH_UNCERTAINTY


def test_anchors_on_one_line_with_the_query_are_degenerate() -> None:
    """Every ray to the query runs along the line: nothing tells how far it is."""
    ahead = Rigid3.from_center(np.tile(np.eye(3), (4, 1, 1)), np.outer([0, 1, 2, 5], [0, 0, 1.0]))
    query = Rigid3.from_center(np.eye(3), np.array([0, 0, 3.0]))
    relative = query @ ahead.inverse()
    unit = Rigid3(relative.R, relative.t / np.linalg.norm(relative.t, axis=1, keepdims=True))
    assert average_poses(ahead, unit, LocalizerOptions()) is Reason.DEGENERATE_ANCHORS
    assert average_poses(ahead[:1], unit[:1], LocalizerOptions()) is Reason.FEW_ANCHORS


def test_a_frame_of_another_size_than_its_camera_is_an_error() -> None:
    with pytest.raises(ConfigError, match=r"is 320 x 240 px, but its camera's .* 640 x 480"):
        Frame(np.zeros((240, 320), np.uint8), CAMERA)


@pytest.mark.parametrize(
    "changes",
    [
        {"num_anchors": 1},
        {"min_inliers": 0},
        {"min_confidence": 40},
        {"anchor_diversity": -1},
        {"first_anchors": 1},
    ],
)
def test_settings_out_of_range_are_errors(changes: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(changes))):
        LocalizerOptions(**changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_camera_on_its_side_is_found_where_asked_for(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]], turns: int
) -> None:
    """What an upright camera saw, turned in the image plane, is what a turned camera sees."""
    frame, truth = flight[0]
    fx, fy, cx, cy, k1, k2, p1, p2 = CAMERA.params
    assert fx == fy
    image = np.ascontiguousarray(np.rot90(frame.image, turns))
    right, bottom = CAMERA.width - 1, CAMERA.height - 1
    middle = ((cy, right - cx), (right - cx, bottom - cy), (bottom - cy, cx))[turns - 1]
    c, s = ((0, -1), (-1, 0), (0, 1))[turns - 1]  # counterclockwise, and y points down
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    p2, p1 = turn[:2, :2] @ (p2, p1)  # tangential distortion is a vector
    height, width = image.shape
    camera = Camera("OPENCV", width, height, (fx, fy, *middle, k1, k2, p1, p2))
    turned = Frame(image, camera)
    assert isinstance(Localizer(model, reader).localize(turned), Lost)
    options = LocalizerOptions(try_turned=True)
    result = Localizer(model, reader, options, clock=time.perf_counter).localize(turned)
    assert isinstance(result, Localized), describe(result)
    assert result.statistics.turned_deg == 360 - 90 * turns
    assert np.linalg.norm(result.cam_from_world.center - truth.center) < 0.02
    R = turn @ truth.R
    assert np.degrees(rotation_angle(result.cam_from_world.R @ R.T)) < 0.3


def test_a_prior_position_leaves_out_anchors_from_elsewhere(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    centers = {name: reader.view(i)[1].center for i, name in enumerate(reader.names())}
    frame, truth = flight[0]
    prior = Prior(tuple(truth.center), 1.5)
    result = Localizer(model, reader).localize(frame, prior)
    assert isinstance(result, Localized), describe(result)
    assert np.linalg.norm(result.cam_from_world.center - truth.center) < 0.02
    distances = [np.linalg.norm(centers[a] - truth.center) for a in result.statistics.anchors]
    assert max(distances) <= 1.5
    assert sum(np.linalg.norm(c - truth.center) > 1.5 for c in centers.values()) > 10


def test_a_wrong_prior_position_makes_no_wrong_pose(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]]
) -> None:
    localizer = Localizer(model, reader)
    centers = [reader.view(index)[1].center for index in range(0, len(reader), 20)]
    for frame, truth in flight:
        for center in centers:
            result = localizer.localize(frame, Prior(tuple(center), 1.0))
            if isinstance(result, Localized):
                assert np.linalg.norm(result.cam_from_world.center - truth.center) < 0.05
    nowhere = localizer.localize(flight[0][0], Prior((500.0, 0.0, 0.0), 1.0))
    assert isinstance(nowhere, Lost)
    assert nowhere.reason == Reason.FEW_ANCHORS
    assert nowhere.detail.startswith("0 images of the map may be used around the prior position")


def test_a_prior_position_does_not_decide_between_two_rooms_that_are_the_same(
    model: FeatureModel, reader: MapReader, flight: list[tuple[Frame, Rigid3]], tmp_path: Path
) -> None:
    next_door = np.array([60.0, 0.0, 0.0])
    path = tmp_path / "twice.tpmap"
    with MapWriter.create(path, model.identity) as writer:
        for offset in (np.zeros(3), next_door):
            for index in range(len(reader)):
                camera, pose = reader.view(index)
                moved = Rigid3.from_center(pose.R, pose.center + offset)
                writer.add(f"{index} {offset[0]}", camera, moved, reader.features(index))
    with MapReader.open(path, model.identity) as twice:
        for offset in (np.zeros(3), next_door):
            frame, truth = flight[0]
            prior = Prior(tuple(truth.center + offset), 20.0)
            assert isinstance(Localizer(model, twice).localize(frame, prior), Lost)
