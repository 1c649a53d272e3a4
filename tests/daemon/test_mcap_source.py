"""Recordings played as a source: whole, odd, and damaged ones."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as PlainWriter
from mcap_protobuf.writer import Writer
from mcap_ros2.writer import Writer as RosWriter
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpoint_db.recording import RecordedImage, write_recording
from trigpointd.sources.base import BadFrame, Captured, Source
from trigpointd.sources.mcap import McapSource

START_NS = 1_700_000_000 * 10**9
WIDTH, HEIGHT = 40, 30
CAMERA = Camera("PINHOLE", WIDTH, HEIGHT, (35, 36, 19.5, 14.5))
CAMERAS = [
    Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (35, 19.5, 14.5)),
    CAMERA,
    Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, (35, 19.5, 14.5, -0.1)),
    Camera("RADIAL", WIDTH, HEIGHT, (35, 19.5, 14.5, -0.1, 0.02)),
    Camera("OPENCV", WIDTH, HEIGHT, (35, 36, 19.5, 14.5, -0.1, 0.02, 0.003, -0.004)),
    Camera("OPENCV_FISHEYE", WIDTH, HEIGHT, (25, 26, 19.5, 14.5, 0.01, -0.02, 0.003, 0.001)),
    Camera("FULL_OPENCV", WIDTH, HEIGHT, (25, 26, 19.5, 14.5, *(i / 100 for i in range(8)))),
]


def picture(i: int) -> NDArray[np.uint8]:
    """Draw noise, a different one for each i."""
    return np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def encoded(i: int, suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, picture(i))[1])


def calibration(frame_id: str = "camera", fx: float = 35, **fields: Any) -> CameraCalibration:
    K = [fx, 0, 19.5, 0, 36, 14.5, 0, 0, 1]
    return CameraCalibration(frame_id=frame_id, width=WIDTH, height=HEIGHT, K=K, **fields)


def image(i: int, frame_id: str = "camera") -> CompressedImage:
    return CompressedImage(frame_id=frame_id, data=encoded(i), format="png")


def write_foxglove(path: Path, messages: Iterable[tuple[str, Any]]) -> Path:
    """Write messages a second apart; their own timestamps are 7 ns before that."""
    with path.open("wb") as stream, Writer(stream, compression=CompressionType.NONE) as writer:
        for i, (topic, message) in enumerate(messages):
            time_ns = START_NS + i * 10**9
            message.timestamp.FromNanoseconds(time_ns - 7)
            writer.write_message(topic, message, time_ns, time_ns, i)
    return path


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Ten frames of one camera, 0.1 s apart."""
    paths = [tmp_path / f"{i}.png" for i in range(10)]
    for i, path in enumerate(paths):
        path.write_bytes(encoded(i))
    write_recording(tmp_path / "recording.mcap", [RecordedImage(p, CAMERA) for p in paths])
    return tmp_path / "recording.mcap"


async def play(source: Source) -> list[Captured]:
    """Take all frames and close the source."""
    try:
        async with contextlib.aclosing(source.frames()) as frames:
            return [c async for c in frames]
    finally:
        await source.close()


def frames_of(path: Path, image_topic: str | None = None) -> list[Frame]:
    """Play a recording of good frames."""
    captured = asyncio.run(play(McapSource(path, image_topic=image_topic)))
    frames = [c.frame for c in captured if isinstance(c.frame, Frame)]
    assert len(frames) == len(captured)
    return frames


def shown(frame: Frame | BadFrame, count: int = 100) -> int | None:
    """Return which of our pictures a frame is."""
    if isinstance(frame, BadFrame):
        return None
    return next(i for i in range(count) if np.array_equal(frame.image, picture(i)))


def test_a_recording_plays_every_frame_in_order(recording: Path) -> None:
    source = McapSource(recording)
    assert not source.live
    frames = frames_of(recording)
    assert [shown(frame) for frame in frames] == list(range(10))
    assert [frame.time_ns - START_NS for frame in frames] == [i * 10**8 for i in range(10)]
    assert {frame.camera for frame in frames} == {CAMERA}
    assert [frame.name for frame in frames[:2]] == ["/camera/image#0", "/camera/image#1"]
    asyncio.run(source.close())


def test_a_recording_plays_twice_alike(recording: Path) -> None:
    async def twice() -> tuple[list[Captured], list[Captured]]:
        source = McapSource(recording)
        async with contextlib.aclosing(source.frames()) as frames:
            first = [c async for c in frames]
        return first, await play(source)

    first, second = asyncio.run(twice())
    assert [shown(c.frame) for c in first] == [shown(c.frame) for c in second] == [*range(10)]


def test_the_input_messages_come_along_unchanged(recording: Path) -> None:
    captured = asyncio.run(play(McapSource(recording)))
    with recording.open("rb") as stream:
        reader = make_reader(stream)
        stored = [m for _, _, m in reader.iter_messages(["/camera/image"])]
        [(schema, channel, calibration)] = reader.iter_messages(["/camera/calibration"])
    images = [c.image for c in captured if c.image is not None]
    assert [m.data for m in images] == [m.data for m in stored]
    assert [m.log_time_ns for m in images] == [m.log_time for m in stored]
    assert {c.calibration for c in captured} == {captured[0].calibration}
    first = captured[0].calibration
    assert first is not None
    assert first.data == calibration.data
    assert schema is not None
    assert first.channel.topic == channel.topic
    assert first.channel.schema == schema.data


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_a_camera_model_survives_the_recording(tmp_path: Path, camera: Camera) -> None:
    (tmp_path / "0.png").write_bytes(encoded(0))
    write_recording(tmp_path / "r.mcap", [RecordedImage(tmp_path / "0.png", camera)])
    [frame] = frames_of(tmp_path / "r.mcap")
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1], [0.5, 0.4, 2], (100, 3))
    assert np.allclose(frame.camera.project(points), camera.project(points), atol=1e-9)
    pixels = camera.project(points)
    assert np.allclose(frame.camera.normalize(pixels), camera.normalize(pixels), atol=1e-9)


def test_each_frame_has_the_newest_calibration_before_it(tmp_path: Path) -> None:
    path = write_foxglove(
        tmp_path / "r.mcap",
        [
            ("/camera/image", image(0)),  # before any calibration: takes the first
            ("/camera/calibration", calibration(fx=35)),
            ("/camera/image", image(1)),
            ("/camera/calibration", calibration(fx=40)),
            ("/camera/calibration", calibration(fx=45)),
            ("/camera/image", image(2)),
            ("/camera/image", image(3)),
        ],
    )
    frames = frames_of(path)
    assert [shown(frame) for frame in frames] == [0, 1, 2, 3]
    assert [frame.camera.focals_px[0] for frame in frames] == [35, 35, 45, 45]


def test_the_capture_time_is_the_messages_own_and_else_that_of_the_log(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with path.open("wb") as stream, Writer(stream) as writer:
        writer.write_message("/camera/calibration", calibration(), 1, 1)
        stamped = image(0)
        stamped.timestamp.FromNanoseconds(START_NS)
        writer.write_message("/camera/image", stamped, START_NS + 5, START_NS + 4)
        writer.write_message("/camera/image", image(1), START_NS + 9, START_NS + 8)
    assert [frame.time_ns for frame in frames_of(path)] == [START_NS, START_NS + 9]


def write_ros(path: Path, *, compressed: bool) -> Path:
    """Write two frames as a ROS 2 driver would, beside another topic."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "CompressedImage" if compressed else "Image"
    with path.open("wb") as stream, RosWriter(stream) as writer:
        text, info_type, image_type = (
            writer.register_msgdef(name, store.generate_msgdef(name, ros_version=2)[0])
            for name in (
                "std_msgs/msg/String",
                *(f"sensor_msgs/msg/{k}" for k in ("CameraInfo", kind)),
            )
        )
        for i in range(2):
            header = {"stamp": {"sec": 1_700_000_000, "nanosec": i}, "frame_id": "optical"}
            info = {
                "header": header,
                "height": HEIGHT,
                "width": WIDTH,
                "distortion_model": "plumb_bob",
                "d": [-0.1, 0.02, 0.003, -0.004, 0.0],
                "k": [35.0, 0, 19.5, 0, 36, 14.5, 0, 0, 1],
                "r": [1.0, 0, 0, 0, 1, 0, 0, 0, 1],
                "p": [33.0, 0, 19, 0, 0, 33, 14, 0, 0, 0, 1, 0],
            }
            size = {"height": HEIGHT, "width": WIDTH, "step": WIDTH}
            pixels = {"encoding": "mono8", "is_bigendian": 0, "data": picture(i).tobytes()}
            file = {"format": "png", "data": encoded(i)}
            sent = {"header": header, **(file if compressed else size | pixels)}
            topic = "/cam/image_raw/compressed" if compressed else "/cam/image_raw"
            writer.write_message("/chatter", text, {"data": "hello"}, i)
            writer.write_message("/cam/camera_info", info_type, info, i)
            writer.write_message(topic, image_type, sent, i)
    return path


@pytest.mark.parametrize("compressed", [True, False])
def test_a_ros_recording_plays(tmp_path: Path, compressed: bool) -> None:
    frames = frames_of(write_ros(tmp_path / "ros.mcap", compressed=compressed))
    assert [shown(frame) for frame in frames] == [0, 1]
    assert [frame.time_ns for frame in frames] == [START_NS, START_NS + 1]
    params = (35, 36, 19.5, 14.5, -0.1, 0.02, 0.003, -0.004)
    assert {frame.camera for frame in frames} == {Camera("OPENCV", WIDTH, HEIGHT, params)}


def test_of_two_cameras_one_must_be_named(tmp_path: Path) -> None:
    path = write_foxglove(
        tmp_path / "r.mcap",
        [
            ("/left/calibration", calibration(fx=35)),
            ("/right/calibration", calibration(fx=40)),
            ("/left/image", image(0)),
            ("/right/image", image(1)),
        ],
    )
    with pytest.raises(SourceError, match="/left/image, /right/image"):
        McapSource(path)
    with pytest.raises(SourceError, match="/middle/image; there are /left/image, /right/image"):
        McapSource(path, image_topic="/middle/image")
    [frame] = frames_of(path, "/right/image")
    assert shown(frame) == 1
    assert frame.camera.focals_px[0] == 40


@pytest.mark.parametrize(
    ("image_topic", "fx"),
    [
        ("/rig/left/image_raw/compressed", 35),  # the innermost namespace around
        ("/rig/image", 40),  # /rig/left is not around it
        ("/odd/image", 50),  # two in the same namespace: by the frame
        ("/other/image", 50),  # none around it: by the frame
    ],
)
def test_the_calibration_is_found_by_namespace_then_by_frame(
    tmp_path: Path, image_topic: str, fx: float
) -> None:
    path = write_foxglove(
        tmp_path / "r.mcap",
        [
            ("/rig/left/calibration", calibration("a", 35)),
            ("/rig/calibration", calibration("b", 40)),
            ("/odd/info1", calibration("c", 45)),
            ("/odd/info2", calibration("optical", 50)),
            (image_topic, image(0, "optical")),
        ],
    )
    [frame] = frames_of(path)
    assert frame.camera.focals_px[0] == fx


@pytest.mark.parametrize(
    "others",
    [
        [],
        [("/left/calibration", calibration("left")), ("/right/calibration", calibration("right"))],
        [("/cam/info1", calibration("cam")), ("/cam/info2", calibration("cam"))],
    ],
)
def test_a_camera_without_a_clear_calibration_is_an_error(
    tmp_path: Path, others: list[tuple[str, Any]]
) -> None:
    path = write_foxglove(tmp_path / "r.mcap", [*others, ("/cam/image", image(0, "cam"))])
    listed = ", ".join(topic for topic, _ in others) or "none"
    with pytest.raises(SourceError, match=rf"/cam/image.*calibrations on: {listed}.*CameraInfo"):
        McapSource(path)


def test_a_camera_that_was_never_calibrated_is_an_error(tmp_path: Path) -> None:
    uncalibrated = CameraCalibration(frame_id="camera", width=WIDTH, height=HEIGHT)
    path = write_foxglove(tmp_path / "r.mcap", [("/c/info", uncalibrated), ("/c/image", image(0))])
    with pytest.raises(SourceError, match=r"r\.mcap: the camera was never calibrated"):
        McapSource(path)


def test_a_recording_without_images_names_its_topics(tmp_path: Path) -> None:
    path = write_foxglove(tmp_path / "r.mcap", [("/camera/calibration", calibration())])
    with pytest.raises(SourceError, match=r"/camera/calibration \(foxglove.CameraCalibration\)"):
        McapSource(path)


def test_rectified_images_play_with_the_projection_matrix(tmp_path: Path) -> None:
    P = [33.0, 0, 19, 0, 0, 34, 14, 0, 0, 0, 1, 0]
    distorted = calibration(distortion_model="plumb_bob", D=[0.1, 0.2, 0, 0, 0.3], P=P)
    path = write_foxglove(
        tmp_path / "r.mcap", [("/cam/camera_info", distorted), ("/cam/image_rect", image(0))]
    )
    [frame] = frames_of(path)
    assert frame.camera == Camera("PINHOLE", WIDTH, HEIGHT, (33, 34, 19, 14))


def test_a_frame_that_cannot_be_used_is_reported_and_the_others_play(tmp_path: Path) -> None:
    good = encoded(1, ".jpg")
    cut = CompressedImage(data=good[: len(good) * 2 // 3], format="jpeg")
    small = CompressedImage(data=bytes(cv2.imencode(".png", np.zeros((9, 9), np.uint8))[1]))
    unreadable = CompressedImage(data=b"\0" * 100)
    path = write_foxglove(
        tmp_path / "r.mcap",
        [
            ("/camera/calibration", calibration()),
            ("/camera/image", image(0)),
            ("/camera/image", cut),
            ("/camera/image", small),
            ("/camera/image", unreadable),
            ("/camera/image", image(2)),
        ],
    )
    first, *bad, last = (c.frame for c in asyncio.run(play(McapSource(path))))
    assert (shown(first), shown(last)) == (0, 2)
    for i, (frame, detail) in enumerate(zip(bad, ["cut short", "9 x 9", "broken"], strict=True)):
        assert isinstance(frame, BadFrame)
        assert frame.time_ns == START_NS + (i + 2) * 10**9 - 7
        assert frame.name == f"/camera/image#{i + 1}"
        assert detail in frame.detail


def test_a_message_that_is_no_image_is_a_bad_frame_at_its_log_time(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with path.open("wb") as stream, Writer(stream) as writer:
        writer.write_message("/camera/calibration", calibration(), 1, 1)
        writer.write_message("/camera/image", image(0), 2, 2)
        # Writer numbers channels from 1: this is the image's.
        writer._writer.add_message(2, 3, b"\xff\xff", 3)
        writer.write_message("/camera/image", image(1), 4, 4)
    first, bad, last = (c.frame for c in asyncio.run(play(McapSource(path))))
    assert (shown(first), shown(last)) == (0, 1)
    assert isinstance(bad, BadFrame)
    assert bad.time_ns == 3


def test_a_bad_calibration_spoils_only_its_frames(tmp_path: Path) -> None:
    path = write_foxglove(
        tmp_path / "r.mcap",
        [
            ("/camera/calibration", calibration()),
            ("/camera/image", image(0)),
            ("/camera/calibration", calibration(fx=0)),
            ("/camera/image", image(1)),
            ("/camera/calibration", calibration()),
            ("/camera/image", image(2)),
        ],
    )
    frames = [c.frame for c in asyncio.run(play(McapSource(path)))]
    assert [shown(frame) for frame in frames] == [0, None, 2]


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(None, "No such file"), (b"", "empty"), (b"\x89MCAP", "not an MCAP"), (b"x" * 999, "not an")],
)
def test_a_file_that_is_no_recording_is_an_error_of_one_line(
    tmp_path: Path, content: bytes | None, complaint: str
) -> None:
    path = tmp_path / "r.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SourceError, match=f"r.mcap: .*{complaint}") as error:
        McapSource(path)
    assert "\n" not in str(error.value)


def test_a_folder_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="directory"):
        McapSource(tmp_path)


def chunked(path: Path, compression: CompressionType = CompressionType.ZSTD) -> Path:
    """Write twelve frames, three to a chunk."""
    with path.open("wb") as stream:
        chunk_bytes = 3 * len(image(0).SerializeToString())
        writer = Writer(stream, chunk_size=chunk_bytes, compression=compression)
        writer.write_message("/camera/calibration", calibration(), START_NS, START_NS)
        for i in range(12):
            writer.write_message("/camera/image", image(i), START_NS + i, START_NS + i)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def frames_in_whole_chunks(path: Path, length: int) -> list[int]:
    """Return the frames that lie in the first bytes of a recording of `chunked`."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) >= 4
    ends_ns = [
        index.message_end_time
        for index in summary.chunk_indexes
        if index.chunk_start_offset + index.chunk_length <= length
    ]
    return list(range(max(ends_ns, default=START_NS - 1) - START_NS + 1))


@given(st.floats(0, 1))
@settings(max_examples=40)
def test_a_recording_cut_off_anywhere_plays_its_whole_chunks(
    tmp_path_factory: pytest.TempPathFactory, share: float
) -> None:
    path = chunked(tmp_path_factory.mktemp("cut") / "r.mcap")
    data = path.read_bytes()
    cut = int(share * (len(data) - 1))
    expected = frames_in_whole_chunks(path, cut)
    path.write_bytes(data[:cut])
    if expected:
        assert [shown(frame) for frame in frames_of(path)] == expected
    else:
        with pytest.raises(SourceError):
            McapSource(path)


def test_a_cut_off_recording_is_announced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = chunked(tmp_path / "r.mcap")
    path.write_bytes(path.read_bytes()[:-20])
    with caplog.at_level(logging.WARNING):
        assert len(frames_of(path)) == 12
    assert [record.message.partition("; ")[0] for record in caplog.records] == [
        f"recording {path} is cut off"
    ]


def test_a_recording_that_ends_in_zeros_plays_its_whole_chunks(tmp_path: Path) -> None:
    path = chunked(tmp_path / "r.mcap")
    data = path.read_bytes()
    half = len(data) // 2
    expected = frames_in_whole_chunks(path, half)
    path.write_bytes(data[:half] + bytes(half))  # as a loss of power may leave it
    assert expected
    assert [shown(frame) for frame in frames_of(path)] == expected


@given(st.data())
@settings(max_examples=40)
def test_whatever_bytes_are_wrong_only_a_source_error_comes_of_it(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = chunked(tmp_path_factory.mktemp("wrong") / "r.mcap")
    content = bytearray(path.read_bytes())
    for position in data.draw(st.lists(st.integers(8, len(content) - 1), max_size=5)):
        content[position] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    with contextlib.suppress(SourceError):
        assert len(asyncio.run(play(McapSource(path)))) <= 12


def test_a_recording_without_an_index_plays(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    indexed = write_foxglove(
        tmp_path / "indexed.mcap", [("/c/i", image(0)), ("/c/c", calibration())]
    )
    with path.open("wb") as stream, indexed.open("rb") as source:
        writer = PlainWriter(
            stream,
            index_types=IndexType.NONE,
            repeat_channels=False,
            repeat_schemas=False,
            use_statistics=False,
            use_summary_offsets=False,
        )
        writer.start()
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
            channel_id = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            writer.add_message(channel_id, message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    assert [shown(frame) for frame in frames_of(path)] == [0]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_damaged_chunk_ends_the_replay_with_an_error(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = chunked(tmp_path / "r.mcap", compression)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    second = summary.chunk_indexes[1]
    data = bytearray(path.read_bytes())
    middle = second.chunk_start_offset + second.chunk_length // 2
    data[middle : middle + 100] = bytes(100)
    path.write_bytes(data)

    async def play_into(seen: list[int | None]) -> None:
        source = McapSource(path)
        try:
            async with contextlib.aclosing(source.frames()) as frames:
                async for captured in frames:
                    seen.append(shown(captured.frame))  # noqa: PERF401
        finally:
            await source.close()

    seen: list[int | None] = []
    with pytest.raises(SourceError, match=r"r\.mcap: the file is damaged .*trigpoint-db recover"):
        asyncio.run(play_into(seen))
    assert seen == list(range(second.message_start_time - START_NS))
    assert seen


def test_the_recorded_pace_is_kept(recording: Path) -> None:
    async def timed() -> tuple[list[Captured], float]:
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        captured = await play(McapSource(recording, rate=9.0))
        return captured, loop.time() - start_s

    captured, elapsed_s = asyncio.run(timed())
    assert len(captured) == 10
    assert elapsed_s >= 0.9 / 9.0


def write_hourly(path: Path) -> Path:
    """Write three frames an hour apart."""
    hour_ns = 3600 * 10**9
    with path.open("wb") as stream, Writer(stream) as writer:
        writer.write_message("/c/calibration", calibration(), 0, 0)
        for i in range(3):
            writer.write_message("/c/image", image(i), i * hour_ns, i * hour_ns)
    return path


def test_without_a_rate_a_recording_of_hours_plays_at_once(tmp_path: Path) -> None:
    frames = frames_of(write_hourly(tmp_path / "r.mcap"))
    assert [shown(frame) for frame in frames] == [0, 1, 2]


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_a_rate_must_be_positive(recording: Path, rate: float) -> None:
    with pytest.raises(ConfigError, match="rate above 0"):
        McapSource(recording, rate=rate)


def test_a_replay_may_be_left_after_a_frame(recording: Path) -> None:
    async def leave() -> list[int | None]:
        source = McapSource(recording)
        async with contextlib.aclosing(source.frames()) as frames:
            seen = [shown((await anext(frames)).frame) for _ in range(2)]
        await source.close()
        return seen

    assert asyncio.run(leave()) == [0, 1]


def test_a_replay_that_waits_for_the_next_frame_can_be_cancelled(tmp_path: Path) -> None:
    path = write_hourly(tmp_path / "r.mcap")

    async def cancel_in_the_pause() -> bool:
        source = McapSource(path, rate=1.0)
        first = asyncio.Event()

        async def consume() -> None:
            async with contextlib.aclosing(source.frames()) as frames:
                async for _ in frames:
                    first.set()

        task = asyncio.create_task(consume())
        await first.wait()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        await source.close()
        return task.cancelled()

    assert asyncio.run(cancel_in_the_pause())


@pytest.mark.parametrize(
    ("start_s", "end_s", "expected"),
    [
        (0.0, None, range(10)),
        (0.3, None, range(3, 10)),
        (0.25, None, range(3, 10)),
        (0.0, 0.3, range(3)),
        (0.3, 0.5, range(3, 5)),
        (0.9, 1e300, range(9, 10)),
    ],
)
def test_a_part_of_a_recording_plays(
    recording: Path, start_s: float, end_s: float | None, expected: range
) -> None:
    source = McapSource(recording, start_s=start_s, end_s=end_s)
    captured = asyncio.run(play(source))
    assert [shown(c.frame) for c in captured] == list(expected)
    assert captured[0].log_time_ns == START_NS + expected[0] * 10**8


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        ({"start_time": 0.3}, range(3, 10)),
        ({"start_time": -3600.0}, range(10)),
        ({"start_time": 0.3, "end_time": 0.5}, range(3, 5)),
        ({"start_time": 0.3, "start_s": 0.5}, range(5, 10)),
        ({"end_time": 0.5, "end_s": 0.3}, range(3)),
    ],
)
def test_a_part_may_be_given_as_times(
    recording: Path, part: dict[str, float], expected: range
) -> None:
    start = datetime.fromtimestamp(START_NS / 1e9, timezone(timedelta(hours=2)))
    limits: dict[str, Any] = {
        key: start + timedelta(seconds=value) if key.endswith("time") else value
        for key, value in part.items()
    }
    captured = asyncio.run(play(McapSource(recording, **limits)))
    assert [shown(c.frame) for c in captured] == list(expected)


@pytest.mark.parametrize(
    ("start_h", "end_h", "complaint"),
    [
        (1, None, "no images from 3600 s; "),
        (None, -1, "no images from 0 s to -3600 s; "),
        (1, -1, "no images from 3600 s to -3600 s; "),
    ],
)
def test_times_without_images_are_an_error_that_tells_when_there_were_some(
    recording: Path, start_h: int | None, end_h: int | None, complaint: str
) -> None:
    first = datetime.fromtimestamp(START_NS / 1e9, UTC)
    start, end = (None if h is None else first + timedelta(hours=h) for h in (start_h, end_h))
    last = f"the last is at 0.900 s, {first:%Y-%m-%dT%H:%M:}"
    with pytest.raises(SourceError, match=complaint + last):
        McapSource(recording, start_time=start, end_time=end)


def test_a_part_begins_with_the_calibration_then_in_force(tmp_path: Path) -> None:
    path = write_foxglove(
        tmp_path / "r.mcap",
        [
            ("/camera/calibration", calibration(fx=35)),
            ("/camera/image", image(0)),
            ("/camera/calibration", calibration(fx=40)),
            ("/camera/image", image(1)),
            ("/camera/image", image(2)),
            ("/camera/calibration", calibration(fx=45)),
            ("/camera/image", image(3)),
        ],
    )
    captured = asyncio.run(play(McapSource(path, start_s=3)))
    frames = [c.frame for c in captured if isinstance(c.frame, Frame)]
    assert [shown(frame) for frame in frames] == [2, 3]
    assert [frame.camera.focals_px[0] for frame in frames] == [40, 45]


@pytest.mark.parametrize(
    ("start_s", "end_s", "complaint"),
    [
        (1.0, None, "no images from 1 s; the last is at 0.900 s"),
        (0.91, 5.0, "no images from 0.91 s to 5 s; the last is at 0.900 s"),
        (0.31, 0.39, "no images from 0.31 s to 0.39 s"),
    ],
)
def test_a_part_without_images_is_an_error(
    recording: Path, start_s: float, end_s: float | None, complaint: str
) -> None:
    with pytest.raises(SourceError, match=rf"recording\.mcap: {complaint}"):
        McapSource(recording, start_s=start_s, end_s=end_s)


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [
        (-1.0, None),
        (2.0, 2.0),
        (2.0, 1.0),
        (float("nan"), None),
        (0.0, float("nan")),
        (1e300, None),
    ],
)
def test_a_part_must_begin_before_it_ends(
    recording: Path, start_s: float, end_s: float | None
) -> None:
    with pytest.raises(ConfigError, match="give a start of 0 or more and an end after it"):
        McapSource(recording, start_s=start_s, end_s=end_s)


def play_some(source: McapSource, count: int) -> list[Captured]:
    """Take the first frames of an endless source."""

    async def take() -> list[Captured]:
        async with contextlib.aclosing(source.frames()) as frames:
            taken = [await anext(frames) for _ in range(count)]
        await source.close()
        return taken

    return asyncio.run(take())


def test_a_loop_begins_again_and_its_times_go_on(recording: Path) -> None:
    captured = play_some(McapSource(recording, start_s=0.7, loop=True), 8)
    assert [shown(c.frame) for c in captured] == [7, 8, 9, 7, 8, 9, 7, 8]
    expected = [START_NS + (7 + i) * 10**8 for i in range(8)]  # at the recorded pace
    assert [c.frame.time_ns for c in captured] == expected
    assert [c.log_time_ns for c in captured] == expected
    assert len({c.frame.name for c in captured}) == 8
    assert all(c.image is None and c.calibration is None for c in captured)


def test_times_rise_in_a_loop_though_images_arrive_late(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with path.open("wb") as stream, Writer(stream) as writer:
        writer.write_message("/camera/calibration", calibration(), START_NS, START_NS)
        for i, delay_ns in enumerate((10**9, 0, 0)):  # the first waited longest
            message = image(i)
            message.timestamp.FromNanoseconds(START_NS + i * 10**9)
            writer.write_message("/camera/image", message, START_NS + i * 10**9 + delay_ns)
    captured = play_some(McapSource(path, loop=True), 9)
    for times_ns in ([c.frame.time_ns for c in captured], [c.log_time_ns for c in captured]):
        assert times_ns == sorted(times_ns)
    assert len({c.frame.time_ns for c in captured}) == 9


def test_a_single_frame_loops(tmp_path: Path) -> None:
    path = write_foxglove(tmp_path / "r.mcap", [("/c/info", calibration()), ("/c/image", image(0))])
    times_ns = [c.frame.time_ns for c in play_some(McapSource(path, loop=True), 3)]
    assert np.diff(times_ns).tolist() == [10**8, 10**8]
