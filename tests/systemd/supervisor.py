"""The end of systemd's notify protocol that systemd holds, and the real daemon at the other."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2

from tests.conftest import Demo
from tests.unit.graphs import hangs_on_white
from trigpoint.images import read_gray
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.recording import RecordedImage, write_recording

TIMEOUT_S = 60


class Supervisor:
    """A daemon and what it notifies its supervisor of."""

    def __init__(self, process: subprocess.Popen[str], channel: socket.socket) -> None:
        self.process = process
        self._channel = channel

    def until(
        self, is_there: Callable[[dict[str, str]], bool], silence_s: float = TIMEOUT_S
    ) -> list[dict[str, str]]:
        """Everything up to a message that is waited for; TimeoutError after a silence."""
        self._channel.settimeout(silence_s)
        messages: list[dict[str, str]] = []
        deadline_s = time.monotonic() + TIMEOUT_S
        while not messages or not is_there(messages[-1]):
            assert time.monotonic() < deadline_s, messages
            assert not messages or "STOPPING" not in messages[-1], messages
            lines = self._channel.recv(4096).decode().splitlines()
            messages.append(dict(line.split("=", 1) for line in lines))
        return messages


@contextlib.contextmanager
def supervised(config: Path, watchdog_s: float) -> Iterator[Supervisor]:
    """A daemon as systemd starts it; it is ended by whoever asked for it."""
    address = config.parent / "notify"
    variables = {"NOTIFY_SOCKET": str(address), "WATCHDOG_USEC": str(int(watchdog_s * 1e6))}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.bind(str(address))
        with subprocess.Popen(
            [sys.executable, "-m", "trigpointd.cli", "run", "--config", str(config)],
            env=os.environ | variables, stderr=subprocess.PIPE, text=True,
        ) as process:  # fmt: skip
            try:
                yield Supervisor(process, channel)
            finally:
                process.kill()


def write_config(folder: Path, map_: Path, recording: Path, *, rate: float, more: str = "") -> Path:
    path = folder / "trigpointd.toml"
    path.write_text(f"""
map = "{map_}"
source = {{ type = "mcap", path = "{recording}", rate = {rate} }}
{more}
""")
    return path


def write_hang(folder: Path, demo: Demo) -> Path:
    """Settings with which the second frame is never done: a network that does not return."""
    network = FeatureModel.load(hangs_on_white(folder / "hangs.onnx"))
    survey = read_model(demo.folder / "sparse")[:1]
    build_map(folder / "hang.tpmap", survey, demo.folder / "survey", network)
    images = sorted((demo.folder / "flight").glob("*.jpg"))
    white = read_gray(images[1])
    white[:32, :32] = 255
    cv2.imwrite(str(folder / "white.png"), white)
    frames = [RecordedImage(path, CAMERA) for path in (images[0], folder / "white.png")]
    write_recording(folder / "hang.mcap", frames)
    return write_config(
        folder,
        folder / "hang.tpmap",
        folder / "hang.mcap",
        rate=0.1,
        more=f'[model]\nnetwork = "{folder / "hangs.onnx"}"',
    )
