"""The live view: a real server on loopback, and viewers that connect to it."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from tests.conftest import Demo
from tests.daemon.outputs import localize_all
from trigpoint.errors import ConfigError
from trigpoint.frame import Frame
from trigpoint.models.features import FeatureModel
from trigpoint_db.demo import CAMERA
from trigpoint_db.recording import RecordedImage, write_recording
from trigpointd.config import FoxgloveConfig
from trigpointd.messages.visuals import Visuals
from trigpointd.pipeline import Output
from trigpointd.sinks.foxglove import FoxgloveSink
from trigpointd.sources.base import Captured

TIMEOUT_S = 60
TOPICS = {
    "/camera/calibration", "/camera/image", "base/anchors", "base/annotations", "base/path",
    "base/points", "base/pose", "base/status", "base/transforms",
}  # fmt: skip
pytest.importorskip("foxglove", reason="needs the extra `foxglove`")
client = pytest.importorskip("websockets.sync.client", reason="needs the package websockets")


@pytest.fixture(scope="module")
def localized(
    demo: Demo, model: FeatureModel, tmp_path_factory: pytest.TempPathFactory
) -> list[Output]:
    """Two frames of the flight."""
    recording = tmp_path_factory.mktemp("live") / "r.mcap"
    images = sorted((demo.folder / "flight").glob("*.jpg"))[:2]
    write_recording(recording, [RecordedImage(image, CAMERA) for image in images])
    return localize_all(recording, demo.map, model)


@pytest.fixture
def sink(port: int) -> Iterator[FoxgloveSink]:
    sink = FoxgloveSink(FoxgloveConfig(port=port), "base")
    yield sink
    sink.close()


class Viewer:
    """Subscribes to everything, and looks for as long as a test may take."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection
        self.deadline_s = time.monotonic() + TIMEOUT_S
        self.topics: dict[int, str] = {}
        self.schemas: dict[str, str] = {}

    def receive(self) -> tuple[str, bytes]:
        """Wait for the next message: topic and data."""
        while True:
            left_s = self.deadline_s - time.monotonic()
            assert left_s > 0, self.topics
            received = self.connection.recv(left_s)
            if isinstance(received, bytes):
                opcode, subscription, _ = struct.unpack_from("<BIQ", received)
                assert opcode == 1
                return self.topics[subscription], received[13:]
            self._answer(json.loads(received))

    def _answer(self, message: dict[str, Any]) -> None:
        if message["op"] == "advertise":
            self.topics |= {channel["id"]: channel["topic"] for channel in message["channels"]}
            self.schemas |= {c["topic"]: c["schemaName"] for c in message["channels"]}
            self._subscribe(*(channel["id"] for channel in message["channels"]))
        elif message["op"] == "status":
            # The server of SDK 0.30 announces a channel a moment before it knows it.
            unknown = re.fullmatch(r"Unknown channel ID: (\d+)", message["message"])
            assert unknown, message
            self._subscribe(int(unknown[1]))

    def _subscribe(self, *ids: int) -> None:
        subscriptions = [{"id": id_, "channelId": id_} for id_ in ids]
        self.connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


@contextlib.contextmanager
def connect(port: int) -> Iterator[Viewer]:
    with client.connect(
        f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None, close_timeout=1
    ) as connection:
        yield Viewer(connection)


@pytest.fixture
def viewer(port: int, sink: FoxgloveSink, localized: list[Output]) -> Iterator[Viewer]:
    """A viewer of a daemon that has had a frame."""
    sink.publish(localized[0])
    with connect(port) as viewer:
        yield viewer


@contextlib.contextmanager
def filming(sink: FoxgloveSink, output: Output) -> Iterator[None]:
    """A camera that delivers the same frame again and again."""
    stop = threading.Event()

    def film() -> None:
        while not stop.wait(0.01):
            sink.publish(output)

    thread = threading.Thread(target=film)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def receive_all(viewer: Viewer, topics: set[str]) -> dict[str, bytes]:
    """Wait until there was a message on each topic."""
    received: dict[str, bytes] = {}
    while not topics <= received.keys():
        topic, data = viewer.receive()
        received[topic] = data
    return received


def test_a_viewer_receives_what_a_log_holds(
    sink: FoxgloveSink, viewer: Viewer, localized: list[Output]
) -> None:
    output = localized[1]
    assert output.captured.image is not None
    drawn = {m.channel.topic: m for m in Visuals("base").draw(output)}
    with filming(sink, output):
        received = receive_all(viewer, TOPICS - {"base/path"})  # that one is sent once a second
    assert received["/camera/image"] == output.captured.image.data
    assert received["base/pose"] == output.pose
    assert received["base/status"] == output.status
    for topic in TOPICS - {"base/path"} & drawn.keys():
        assert received[topic] == drawn[topic].data
    assert set(viewer.topics.values()) == TOPICS
    assert {viewer.schemas[topic] for topic in drawn} == {
        message.channel.schema_name for message in drawn.values()
    }


def test_a_camera_without_messages_is_shown_in_gray(
    sink: FoxgloveSink, viewer: Viewer, localized: list[Output]
) -> None:
    frame = localized[0].captured.frame
    assert isinstance(frame, Frame)
    bare = replace(localized[0], captured=Captured(frame, frame.time_ns))
    with filming(sink, bare):
        while True:
            received = receive_all(viewer, {"/camera/image", "/camera/calibration"})
            if viewer.schemas["/camera/image"] == "foxglove.RawImage":
                break
    image = RawImage.FromString(received["/camera/image"])
    assert (image.width, image.height, image.encoding) == (640, 480, "mono8")
    assert image.data == frame.image.tobytes()
    calibration = CameraCalibration.FromString(received["/camera/calibration"])
    np.testing.assert_allclose(np.reshape(calibration.K, (3, 3)), CAMERA.K)


def test_a_viewer_that_hangs_holds_up_nobody(
    port: int, sink: FoxgloveSink, viewer: Viewer, localized: list[Output]
) -> None:
    with connect(port) as hanging, filming(sink, localized[0]):
        hanging.receive()  # it has subscribed, and reads nothing from now on
        count = 0
        while count < 300:  # of 80 kB: more than any buffer on the way
            topic, _ = viewer.receive()
            count += topic == "/camera/image"


def test_a_port_in_use_is_one_line(port: int) -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", port))
        listener.listen()
        with pytest.raises(ConfigError, match=rf"127\.0\.0\.1:{port}.*in use") as caught:
            FoxgloveSink(FoxgloveConfig(port=port), "base")
    assert "\n" not in str(caught.value)


def test_the_daemon_serves_it_until_sigterm(demo: Demo, tmp_path: Path, port: int) -> None:
    config = tmp_path / "trigpointd.toml"
    config.write_text(f"""
map = "{demo.map}"
base_key = "base"
source = {{ type = "mcap", path = "{demo.recording}", rate = 1.0, loop = true }}
foxglove = {{ port = {port} }}
""")
    command = [sys.executable, "-m", "trigpointd.cli", "run", "--config", str(config)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as daemon:
        assert daemon.stderr is not None
        while "localizing" not in daemon.stderr.readline():
            assert daemon.poll() is None
        with connect(port) as viewer:
            received = receive_all(viewer, {"base/status", "base/annotations"})
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(TIMEOUT_S) == 0
    assert json.loads(received["base/status"])["num_features"] > 0
