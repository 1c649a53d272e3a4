"""What is drawn of outputs, held against the results themselves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from tests.conftest import Demo
from tests.daemon.outputs import BODY_FROM_CAMERA, localize_all
from trigpoint.database.reader import MapReader
from trigpoint.frame import Failed, Frame, Localized, Lost, Reason
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpoint_db.demo import CAMERA
from trigpoint_db.recording import RecordedImage, write_recording
from trigpointd.messages.cdr import encode_pose
from trigpointd.messages.foxglove import calibration_message
from trigpointd.messages.visuals import PATH_PERIOD_NS, PATH_STEP_NS, PATH_STEPS, Visuals
from trigpointd.pipeline import Output
from trigpointd.sources.base import BadFrame

KINDS: dict[str, Any] = {
    "annotations": ImageAnnotations,
    "anchors": SceneUpdate,
    "points": PointCloud,
    "path": SceneUpdate,
    "transforms": FrameTransforms,
}


@pytest.fixture(scope="module")
def outputs(
    demo: Demo, model: FeatureModel, tmp_path_factory: pytest.TempPathFactory
) -> list[Output]:
    """Two frames of the flight, a black one, a third frame of the flight."""
    folder = tmp_path_factory.mktemp("visuals")
    cv2.imwrite(str(folder / "dark.png"), np.zeros((480, 640), np.uint8))
    flight = sorted((demo.folder / "flight").glob("*.jpg"))
    paths = [*flight[:2], folder / "dark.png", flight[2]]
    write_recording(folder / "r.mcap", [RecordedImage(path, CAMERA) for path in paths])
    outputs = localize_all(folder / "r.mcap", demo.map, model)
    assert [output.outcome for output in outputs] == [
        "LOCALIZED", "LOCALIZED", "TOO_DARK", "LOCALIZED"
    ]  # fmt: skip
    return outputs


def draw(visuals: Visuals, output: Output) -> dict[str, Any]:
    """Draw an output, and decode the messages by the last part of their topics."""
    decoded = {}
    for message in visuals.draw(output):
        base, _, name = message.channel.topic.rpartition("/")
        assert base == "trigpoint/test"
        assert message.channel.schema_name == KINDS[name].DESCRIPTOR.full_name
        assert message.log_time_ns == output.captured.log_time_ns
        decoded[name] = KINDS[name].FromString(message.data)
    return decoded


@pytest.fixture
def visuals() -> Visuals:
    return Visuals("trigpoint/test")


def localized(output: Output) -> Localized:
    assert isinstance(output.result, Localized)
    return output.result


def xy(points: Any) -> NDArray[np.float64]:
    return np.array([[point.x, point.y] for point in points]).reshape(-1, 2)


def xyz(points: Any) -> NDArray[np.float64]:
    return np.array([[point.x, point.y, point.z] for point in points]).reshape(-1, 3)


def to_rigid(transform: Any) -> Rigid3:
    t, q = transform.translation, transform.rotation
    return Rigid3.from_quaternion([q.w, q.x, q.y, q.z], [t.x, t.y, t.z])


def test_dots_are_where_the_latent_points_project(visuals: Visuals, outputs: list[Output]) -> None:
    result = localized(outputs[0])
    annotations = draw(visuals, outputs[0])["annotations"]
    dots, lines = annotations.points
    assert (dots.type, lines.type) == (PointsAnnotation.POINTS, PointsAnnotation.LINE_LIST)
    assert dots.timestamp.ToNanoseconds() == outputs[0].time_ns
    assert len(dots.points) == result.statistics.num_inliers
    points3d = result.support.points3d[result.support.inliers]
    projected = CAMERA.project(result.cam_from_world.apply(points3d))
    # Foxglove's origin is the corner of the top-left pixel, ours its centre.
    errors_px = np.linalg.norm(xy(dots.points) - 0.5 - projected, axis=1)
    assert np.median(errors_px) < 0.6
    assert errors_px.max() < 5
    starts, ends = xy(lines.points)[::2], xy(lines.points)[1::2]
    assert 0 < len(starts) <= (~result.support.inliers).sum()
    assert np.linalg.norm(ends - starts, axis=1).min() > 3.9  # the limit for inliers is 4 px
    assert len(annotations.texts) == 0


def test_anchors_stand_where_the_map_has_them(
    visuals: Visuals, outputs: list[Output], demo: Demo, model: FeatureModel
) -> None:
    result = localized(outputs[0])
    counts = np.array(result.statistics.anchor_inliers)
    counts[1] = 0
    used = counts > 0
    statistics = replace(result.statistics, anchor_inliers=tuple(counts.tolist()))
    result = replace(result, statistics=statistics)
    [entity] = draw(visuals, replace(outputs[0], result=result))["anchors"].entities
    assert entity.frame_id == "map"
    with MapReader.open(demo.map, model.identity) as reader:
        centers = {
            anchor.name: anchor.cam_from_world.center
            for anchor in map(reader.anchor, range(len(reader)))
        }
    names = [text.text.split(" ")[0] for text in entity.texts]
    assert tuple(names) == result.statistics.anchors
    expected = np.array([centers[name] for name in names])
    np.testing.assert_allclose(xyz(text.pose.position for text in entity.texts), expected)
    *pyramids, sights = entity.lines
    tips = np.vstack([xyz(pyramid.points)[::5] for pyramid in pyramids])
    np.testing.assert_allclose(tips, np.vstack([expected[used], expected[~used]]))
    np.testing.assert_allclose(
        xyz(sights.points), np.vstack([result.cam_from_world.center, expected[used]])
    )
    assert all(max(line.indices) == len(line.points) - 1 for line in entity.lines)
    greens = [text.color.g > text.color.r for text in entity.texts]
    assert greens == used.tolist()
    assert [int(text.text.split("(")[1].rstrip(")")) for text in entity.texts] == counts.tolist()


def test_transforms_lead_from_the_map_to_the_camera(
    visuals: Visuals, outputs: list[Output]
) -> None:
    to_body, to_camera = draw(visuals, outputs[0])["transforms"].transforms
    assert (to_body.parent_frame_id, to_body.child_frame_id) == ("map", "body")
    assert (to_camera.parent_frame_id, to_camera.child_frame_id) == ("body", "camera")
    body_from_camera = to_rigid(to_camera)
    np.testing.assert_allclose(body_from_camera.R, BODY_FROM_CAMERA.R, atol=1e-9)
    np.testing.assert_allclose(body_from_camera.t, BODY_FROM_CAMERA.t, atol=1e-9)
    cam_from_world = (to_rigid(to_body) @ body_from_camera).inverse()
    expected = localized(outputs[0]).cam_from_world
    np.testing.assert_allclose(cam_from_world.R, expected.R, atol=1e-9)
    np.testing.assert_allclose(cam_from_world.t, expected.t, atol=1e-9)


def test_a_camera_whose_frame_is_the_body_has_one_transform(
    visuals: Visuals, outputs: list[Output]
) -> None:
    calibration = calibration_message(CAMERA, 0)
    message = CameraCalibration.FromString(calibration.data)
    message.frame_id = "body"
    renamed = replace(calibration, data=message.SerializeToString())
    captured = replace(outputs[0].captured, calibration=renamed)
    [only] = draw(visuals, replace(outputs[0], captured=captured))["transforms"].transforms
    assert only.child_frame_id == "body"


def test_points_are_the_inliers(visuals: Visuals, outputs: list[Output]) -> None:
    cloud, support = draw(visuals, outputs[0])["points"], localized(outputs[0]).support
    assert cloud.frame_id == "map"
    offsets = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    found = offsets + xyz([cloud.pose.position])
    np.testing.assert_allclose(found, support.points3d[support.inliers], atol=1e-5)


def test_without_a_pose_the_image_says_why_and_the_map_is_cleared_once(
    visuals: Visuals, outputs: list[Output]
) -> None:
    draw(visuals, outputs[0])
    first, second = draw(visuals, outputs[2]), draw(visuals, outputs[2])
    [text] = first["annotations"].texts
    assert text.text.startswith("TOO_DARK: contrast")
    [deletion] = first["anchors"].deletions
    assert deletion.type == deletion.ALL
    assert first["points"].data == b""
    assert second.keys() == {"annotations"}
    assert "anchors" in draw(visuals, outputs[3])


def test_what_a_refused_pose_rests_on_is_drawn_in_another_color(
    visuals: Visuals, outputs: list[Output]
) -> None:
    given = localized(outputs[0])
    refused = Lost(Reason.LOW_CONFIDENCE, given.statistics, "0.50", given.support)
    good = draw(visuals, outputs[0])["annotations"]
    bad = draw(visuals, replace(outputs[0], result=refused, pose=None))["annotations"]
    assert [text.text for text in bad.texts] == ["LOW_CONFIDENCE: 0.50"]
    assert xy(bad.points[0].points).tolist() == xy(good.points[0].points).tolist()
    assert bad.points[0].outline_color != good.points[0].outline_color


def test_a_frame_that_cannot_be_read_has_its_text(visuals: Visuals, outputs: list[Output]) -> None:
    captured = replace(outputs[0].captured, frame=BadFrame(5, "", ""))
    bad = Output(captured, Failed("BAD_FRAME", "the image is " + 100 * "very "), None, b"{}")
    drawn = draw(visuals, bad)
    assert drawn.keys() == {"annotations"}
    [text] = drawn["annotations"].texts
    assert text.text.startswith("BAD_FRAME: the image is very very")
    assert len(text.text) < 100


def at(output: Output, time_ns: int, x_m: float, map_frame: str = "map") -> Output:
    """The same frame, taken at another time and place."""
    pose = encode_pose(time_ns, map_frame, Rigid3(np.eye(3), np.array([x_m, 0, 0])), np.eye(6))
    assert isinstance(output.captured.frame, Frame)
    frame = replace(output.captured.frame, time_ns=time_ns)
    return replace(output, captured=replace(output.captured, frame=frame), pose=pose)


def shown(visuals: Visuals, outputs: list[Output]) -> list[Any]:
    """The paths that are shown, one after the other."""
    drawn = [draw(visuals, output) for output in outputs]
    return [entity.lines[0] for d in drawn if "path" in d for entity in d["path"].entities
            if entity.lines]  # fmt: skip


def test_the_path_is_bounded_and_rarely_sent(visuals: Visuals, outputs: list[Output]) -> None:
    num_frames = 2 * (PATH_STEPS + 100)  # two to a step
    flight = [at(outputs[0], 10**18 + i * PATH_STEP_NS // 2, float(i)) for i in range(num_frames)]
    paths = shown(visuals, flight)
    length_ns = num_frames * PATH_STEP_NS // 2
    assert length_ns // PATH_PERIOD_NS - 1 <= len(paths) <= length_ns // PATH_PERIOD_NS + 1
    x = xyz(paths[-1].points)[:, 0]
    assert len(x) == PATH_STEPS
    np.testing.assert_array_equal(np.diff(x), 2.0)
    assert list(paths[-1].indices) == [e for i in range(1, len(x)) for e in (i - 1, i)]


def test_the_path_has_a_gap_where_there_was_no_pose(
    visuals: Visuals, outputs: list[Output]
) -> None:
    flight = [at(outputs[0], 10**18 + i * PATH_PERIOD_NS, float(i)) for i in range(4)]
    paths = shown(visuals, [*flight[:2], outputs[2], *flight[2:]])
    assert list(paths[-1].indices) == [0, 1, 2, 3]


def test_the_path_begins_anew_in_another_map(visuals: Visuals, outputs: list[Output]) -> None:
    times_ns = [10**18 + i * PATH_PERIOD_NS for i in range(5)]
    shown(visuals, [at(outputs[0], time_ns, 1.0) for time_ns in times_ns[:3]])
    [path] = shown(visuals, [at(outputs[0], t, 2.0, "other") for t in times_ns[3:]])
    assert xyz(path.points)[:, 0].tolist() == [2.0, 2.0]


def test_a_clock_set_back_does_not_stop_the_path(visuals: Visuals, outputs: list[Output]) -> None:
    times_ns = [10**18, 10**18 - 3600 * 10**9]
    [path] = shown(visuals, [at(outputs[0], time_ns, 1.0) for time_ns in times_ns])
    assert len(path.points) == 2


def test_the_same_outputs_are_drawn_the_same(outputs: list[Output]) -> None:
    first, second = Visuals("base"), Visuals("base")
    for output in outputs:
        assert [m.data for m in first.draw(output)] == [m.data for m in second.draw(output)]
