"""A daemon's process before a film, and a subscriber in this one."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import zenoh

from trigpoint.errors import ConfigError, TrigpointError
from trigpoint.images import read_gray
from trigpoint_db.demo import CAMERA

BASE_KEY = "trigpoint/bench"
_ROOT = Path(__file__).parents[2]
_GRAY = 128  # chroma of what has no colour
_START_S, _STOP_S = 60, 30
_MAX_FRAMES = 32  # V4L2's limit of buffers
Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class Setup:
    """What the daemon is run with; `log` are the settings of that table."""

    demo: Path  # as `trigpoint-db demo` makes it
    folder: Path  # for what is written
    format: str  # "YUYV" or "MJPG"
    fps: float
    log: Mapping[str, object]
    requests: tuple[str, ...] = ()  # to allow

    @property
    def film(self) -> Path:
        """The folder that stands for the camera."""
        return self.folder / "film"

    def prepare(self, port: int) -> Path:
        """Empty the folder, write the film, and the settings, whose path is returned."""
        settings = self.folder / "trigpointd.toml"
        if self.folder.is_dir() and any(self.folder.iterdir()):
            if not settings.is_file():
                raise ConfigError(f"{self.folder} holds something else; name another folder")
            shutil.rmtree(self.folder)
        self.film.mkdir(parents=True)
        pictures = sorted((self.demo / "flight").glob("*.jpg"))
        if len(pictures) < 2:
            raise ConfigError(f"{self.demo} holds no demo; make one: trigpoint-db demo {self.demo}")
        for path in pictures[:: -(-len(pictures) // _MAX_FRAMES)]:
            (self.film / path.stem).write_bytes(_encode(path, self.format))
        shutil.copy(self.demo / "map.tpmap", self.folder)
        log = "\n".join(f"{key} = {json.dumps(value)}" for key, value in self.log.items())
        settings.write_text(f"""
map = "map.tpmap"
base_key = "{BASE_KEY}"

[source]
type = "v4l2"
device = "film"
camera = "{CAMERA.to_text()}"
format = "{self.format}"
fps = {self.fps}

[zenoh]
connect = ["tcp/127.0.0.1:{port}"]
multicast_scouting = false
wait_for_subscriber_s = {_START_S}

[zenoh.requests]
allow = {json.dumps(self.requests)}

[log]
path = "log.mcap"
{log}
""")
        return settings


def _encode(path: Path, pixel_format: str) -> bytes:
    gray = read_gray(path)
    if pixel_format == "YUYV":
        return np.stack([gray, np.full_like(gray, _GRAY)], axis=2).tobytes()
    # As cameras for USB do: 4:2:2, some 50 kB.
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422]
    how = [*sampling, cv2.IMWRITE_JPEG_QUALITY, 80]
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), how)[1])


@contextlib.contextmanager
def subscriber(receive: Callable[[str, bytes, int], None]) -> Iterator[tuple[zenoh.Session, int]]:
    """Listen on a port of loopback; `receive` gets the end of the key, what came, and when."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = zenoh.Config()
    settings.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    settings.insert_json5("scouting/multicast/enabled", "false")

    def arrived(sample: zenoh.Sample) -> None:
        now_ns = time.time_ns()
        receive(str(sample.key_expr).rsplit("/", 1)[1], sample.payload.to_bytes(), now_ns)

    with zenoh.open(settings) as session:
        # In the thread that receives: a Python thread of its own would take longer to wake.
        handler = zenoh.handlers.Callback(arrived, indirect=False)
        session.declare_subscriber(f"{BASE_KEY}/*", handler)
        yield session, port


@contextlib.contextmanager
def running(settings: Path, *launch: str, **environment: str) -> Iterator[Process]:
    """Run the daemon by a module and its arguments; it must live, and end in order."""
    command = [sys.executable, "-m", *launch, "run", "--config", str(settings.resolve())]
    with (settings.parent / "stderr.txt").open("wb") as stderr:
        process = Process(command, cwd=_ROOT, stderr=stderr, env={**os.environ, **environment})
    try:
        yield process
        check_alive(process)
        process.send_signal(signal.SIGTERM)
        if process.wait(_STOP_S):
            raise _ended(process)
    finally:
        process.kill()
        process.wait()


def check_alive(process: Process) -> None:
    """Raise an error where the daemon has ended."""
    if process.poll() is not None:
        raise _ended(process)


def _ended(process: Process) -> TrigpointError:
    return TrigpointError(f"the daemon ended with {process.returncode}; see its stderr.txt")
