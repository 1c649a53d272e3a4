"""The log: what is in it, how it replays, and what a crash leaves of it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as RosDecoders
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.daemon.logs import numbered, numbers_in, numbers_in_unfinished
from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Failed, Frame
from trigpoint.rigid import Rigid3
from trigpoint_db.recording import RecordedImage, write_recording
from trigpointd.messages.cdr import encode_pose
from trigpointd.pipeline import Output
from trigpointd.sinks.mcap import McapLog
from trigpointd.sources.base import BadFrame, Captured, Channel, Message
from trigpointd.sources.mcap import McapSource

START_NS = 1_700_000_000 * 10**9
CAMERA = Camera("PINHOLE", 40, 30, (35, 36, 19.5, 14.5))
WIDE = Camera("OPENCV_FISHEYE", 40, 30, (25, 26, 19.5, 14.5, 0.1, 0.2, 0.3, 0.4))
POSE = Rigid3.from_quaternion([0.5, -0.1, 0.7, 0.2], [1.0, 2.0, 3.0])
COVARIANCE = np.arange(36.0).reshape(6, 6)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Eight frames 0.1 s apart; the camera changes in the middle."""
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{i}.png" for i in range(8)]
    for path in paths:
        cv2.imwrite(str(path), rng.integers(0, 256, (30, 40), dtype=np.uint8))
    cameras = [CAMERA] * 4 + [WIDE] * 4
    write_recording(tmp_path / "recording.mcap", map(RecordedImage, paths, cameras))
    return tmp_path / "recording.mcap"


def play(path: Path) -> list[Captured]:
    async def collect() -> list[Captured]:
        source = McapSource(path)
        async with contextlib.aclosing(source.frames()) as frames:
            captured = [c async for c in frames]
        await source.close()
        return captured

    return asyncio.run(collect())


def output(captured: Captured, status: bytes = b"{}", pose: bytes | None = None) -> Output:
    return Output(captured, Failed("BAD_FRAME", ""), pose, status)


def write_log(path: Path, captured: list[Captured], *, frames: bool = True) -> Path:
    """Log all of each frame."""
    log = McapLog(path, "trigpoint/drone", frames=frames)
    for c in captured:
        pose = encode_pose(c.frame.time_ns, "map", POSE, COVARIANCE)
        log.publish(output(c, json.dumps({"time_ns": c.frame.time_ns}).encode(), pose))
    log.close()
    return path


def test_other_readers_read_the_log(tmp_path: Path, recording: Path) -> None:
    path = write_log(tmp_path / "log.mcap", play(recording))
    decoders = [ProtobufDecoders(), RosDecoders()]
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=decoders)
        images = list(reader.iter_decoded_messages(["/camera/image"]))
        calibrations = list(reader.iter_decoded_messages(["/camera/calibration"]))
        poses = list(reader.iter_decoded_messages(["trigpoint/drone/pose"]))
        statuses = list(reader.iter_messages(["trigpoint/drone/status"]))

    times = [START_NS + i * 10**8 for i in range(8)]
    assert [i.decoded_message.timestamp.ToNanoseconds() for i in images] == times
    assert [c.decoded_message.distortion_model for c in calibrations] == [
        "plumb_bob",
        "kannala_brandt",
    ]
    stamps = [p.decoded_message.header.stamp for p in poses]
    assert [stamp.sec * 10**9 + stamp.nanosec for stamp in stamps] == times
    pose = poses[0].decoded_message.pose
    position, orientation = pose.pose.position, pose.pose.orientation
    assert (position.x, position.y, position.z) == (1, 2, 3)
    wxyz = (orientation.w, orientation.x, orientation.y, orientation.z)
    assert np.allclose(wxyz, POSE.quaternion)
    assert list(pose.covariance) == list(range(36))
    assert [json.loads(message.data)["time_ns"] for _, _, message in statuses] == times
    [schema] = {schema.data for schema, _, _ in statuses if schema is not None}
    assert json.loads(schema) == {"type": "object"}


def test_rosbags_reads_the_poses_by_the_schema_in_the_log(tmp_path: Path, recording: Path) -> None:
    path = write_log(tmp_path / "log.mcap", play(recording))
    with path.open("rb") as stream:
        [(schema, _, message), *_] = make_reader(stream).iter_messages(["trigpoint/drone/pose"])
    assert schema is not None
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.data.decode(), schema.name))
    pose: Any = store.deserialize_cdr(message.data, schema.name)
    assert pose.header.frame_id == "map"
    assert (pose.pose.pose.position.x, pose.pose.pose.position.z) == (1, 3)


def assert_same_frames(replayed: list[Captured], original: list[Captured]) -> None:
    for a, b in zip(replayed, original, strict=True):
        assert isinstance(a.frame, Frame)
        assert isinstance(b.frame, Frame)
        assert np.array_equal(a.frame.image, b.frame.image)
        assert a.frame.camera == b.frame.camera
        assert (a.frame.time_ns, a.log_time_ns) == (b.frame.time_ns, b.log_time_ns)


def test_a_log_replays_like_the_recording(tmp_path: Path, recording: Path) -> None:
    original = play(recording)
    path = write_log(tmp_path / "log.mcap", original)
    assert_same_frames(play(path), original)
    again = write_log(tmp_path / "again.mcap", play(path))
    assert again.read_bytes() == path.read_bytes()


def test_a_log_of_some_frames_replays_these(tmp_path: Path, recording: Path) -> None:
    kept = play(recording)[3::2]  # the first frame after the change of the camera is dropped
    assert_same_frames(play(write_log(tmp_path / "log.mcap", kept)), kept)


def test_a_log_without_frames_holds_poses_and_status(tmp_path: Path, recording: Path) -> None:
    path = write_log(tmp_path / "log.mcap", play(recording), frames=False)
    with path.open("rb") as stream:
        topics = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert topics == ["trigpoint/drone/pose", "trigpoint/drone/status"] * 8
    with pytest.raises(SourceError, match="no images"):
        McapSource(path)


def test_a_frame_without_a_pose_leaves_its_status_alone(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "log.mcap", "base")
    log.publish(output(Captured(BadFrame(1, "", ""), 2)))
    log.close()
    with (tmp_path / "log.mcap").open("rb") as stream:
        [(_, channel, message)] = make_reader(stream).iter_messages()
    assert (channel.topic, message.data, message.log_time) == ("base/status", b"{}", 2)


def test_messages_without_a_schema_are_kept(tmp_path: Path) -> None:
    raw = Message(Channel("text", "json", "", "", b""), b"[]", 5, 4, 3)
    log = McapLog(tmp_path / "log.mcap", "base")
    log.publish(output(Captured(BadFrame(0, "", ""), 5, raw)))
    log.close()
    with (tmp_path / "log.mcap").open("rb") as stream:
        [(schema, channel, message), _] = make_reader(stream).iter_messages()
    assert schema is None
    assert (channel.topic, channel.message_encoding, message.data) == ("text", "json", b"[]")
    assert (message.log_time, message.publish_time, message.sequence) == (5, 4, 3)


def test_a_file_that_exists_is_replaced_only_on_request(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(ConfigError, match=r"log\.mcap exists"):
        McapLog(path, "base")
    assert path.read_bytes() == b"precious"
    McapLog(path, "base", overwrite=True).close()
    assert path.read_bytes().startswith(b"\x89MCAP")


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"missing/log\.mcap: No such file"):
        McapLog(tmp_path / "missing" / "log.mcap", "base")


@pytest.fixture
def _small_disk() -> Iterator[None]:
    """Let no file grow beyond 1 MB; writing on fails as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10**6, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def publish_all(log: McapLog, count: int) -> None:
    for i in range(count):
        log.publish(numbered(i, noise_bytes=50_000))


@pytest.mark.usefixtures("_small_disk")
def test_a_full_disk_ends_the_log_and_leaves_what_was_written(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "log.mcap", "base")
    with pytest.raises(SourceError, match=r"log\.mcap: File too large"):
        publish_all(log, 1000)
    with pytest.raises(SourceError, match="closed"):
        log.publish(numbered(0))
    log.close()  # harmless
    found = numbers_in_unfinished(tmp_path / "log.mcap")
    assert found == list(range(len(found)))
    assert 6 <= len(found) < 10  # of 100 kB, three to a chunk


CHILD = """
import json, pathlib, sys
from trigpoint.frame import Failed
from trigpointd.pipeline import Output
from trigpointd.sinks.mcap import McapLog
from trigpointd.sources.base import BadFrame, Captured
log = McapLog(pathlib.Path(sys.argv[1]), "base", frames=False)
for i in range(22):  # of 100 kB, three to a chunk
    status = json.dumps({"i": i, "noise": "x" * 100_000}).encode()
    log.publish(Output(Captured(BadFrame(i, "", ""), i), Failed("BAD_FRAME", ""), None, status))
if sys.argv[2] == "flush":
    log.flush()
print("written", flush=True)
sys.stdin.read()  # until killed
"""


@pytest.mark.parametrize(("last", "at_least"), [("flush", 22), ("no flush", 21)])
def test_a_killed_process_loses_only_the_chunk_in_progress(
    tmp_path: Path, last: str, at_least: int
) -> None:
    path = tmp_path / "log.mcap"
    environment = {"PYTHONPATH": ":".join(p for p in sys.path if p)}
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), last],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        text=True,
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "written\n"
        child.kill()
    found = numbers_in_unfinished(path)
    assert found == list(range(len(found)))
    assert len(found) >= at_least


def test_what_is_flushed_can_be_read(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "log.mcap", "base")
    log.publish(numbered(0))
    assert not log.holds_messages
    assert numbers_in_unfinished(tmp_path / "log.mcap") == []
    log.flush()
    assert log.holds_messages
    assert numbers_in_unfinished(tmp_path / "log.mcap") == [0]
    log.close()


def test_a_log_has_one_writer(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "log.mcap", "base")
    log.publish(numbered(7))
    with pytest.raises(ConfigError, match=r"another daemon is writing the log .*log\.mcap"):
        McapLog(tmp_path / "log.mcap", "base", overwrite=True)
    log.close()
    assert numbers_in(tmp_path / "log.mcap") == [7]
    McapLog(tmp_path / "log.mcap", "base", overwrite=True).close()
    assert numbers_in(tmp_path / "log.mcap") == []


def test_a_log_says_what_it_is_about(tmp_path: Path) -> None:
    McapLog(tmp_path / "log.mcap", "base", about={"settings": "{}"}).close()
    with (tmp_path / "log.mcap").open("rb") as stream:
        [metadata] = make_reader(stream).iter_metadata()
    assert (metadata.name, metadata.metadata) == ("trigpoint", {"settings": "{}"})


CAMERAS = [
    Camera("SIMPLE_PINHOLE", 40, 30, (35, 19.5, 14.5)),
    Camera("SIMPLE_RADIAL", 40, 30, (35, 19.5, 14.5, -0.1)),
    Camera("OPENCV", 40, 30, (35, 36, 19.5, 14.5, -0.1, 0.02, 0.003, -0.004)),
    WIDE,
]


def test_frames_that_came_without_messages_replay_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    original = [
        Captured(Frame(rng.integers(0, 256, (30, 40), dtype=np.uint8), camera, START_NS + i), i + 1)
        for i, camera in enumerate(c for c in CAMERAS for _ in range(2))
    ]
    replayed = play(write_log(tmp_path / "log.mcap", original))
    pixels = rng.uniform([0, 0], [39, 29], (100, 2))
    for a, b in zip(replayed, original, strict=True):
        assert isinstance(a.frame, Frame)
        assert isinstance(b.frame, Frame)
        assert np.array_equal(a.frame.image, b.frame.image)
        assert (a.frame.time_ns, a.log_time_ns) == (b.frame.time_ns, b.log_time_ns)
        assert np.array_equal(a.frame.camera.normalize(pixels), b.frame.camera.normalize(pixels))
    with (tmp_path / "log.mcap").open("rb") as stream:
        decoded = make_reader(stream, decoder_factories=[ProtobufDecoders()])
        calibrations = list(decoded.iter_decoded_messages(["/camera/calibration"]))
    assert len(calibrations) == len(CAMERAS)


def test_a_log_of_frames_replays_like_a_log_of_messages(tmp_path: Path, recording: Path) -> None:
    original = play(recording)
    bare = [Captured(c.frame, c.log_time_ns) for c in original]
    assert_same_frames(play(write_log(tmp_path / "log.mcap", bare)), original)
