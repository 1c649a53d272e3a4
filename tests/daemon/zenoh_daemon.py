"""A daemon in a thread, with a camera that never ends, and the sessions that talk to it."""

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import AsyncGenerator, Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from trigpoint.database.reader import MapReader
from trigpoint.frame import Frame
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint_db.demo import BODY_FROM_CAMERA, CAMERA
from trigpointd.config import Config, McapConfig, ZenohConfig
from trigpointd.pipeline import Pipeline
from trigpointd.request_queue import RequestQueue
from trigpointd.requests import Responder
from trigpointd.service import serve
from trigpointd.sinks.zenoh import ZenohSink
from trigpointd.sources.base import Captured

TIMEOUT_S = 60


class Camera:
    """A live camera that shows the same picture over and over, or so many times."""

    live = True
    problem = ""

    def __init__(self, picture: Path, num_frames: int | None = None) -> None:
        self._image = read_gray(picture)
        self._num_frames = num_frames

    async def frames(self) -> AsyncGenerator[Captured, None]:
        time_ns = 0
        while self._num_frames is None or time_ns < self._num_frames:
            time_ns += 1
            yield Captured(Frame(self._image, CAMERA, time_ns), time_ns)
            await asyncio.sleep(0.01)
        await asyncio.Event().wait()  # until it is cancelled

    async def close(self) -> None:
        pass


@contextlib.contextmanager
def running(
    camera: Camera, map_: Path, model: FeatureModel, zenoh_: ZenohConfig
) -> Iterator[ZenohSink]:
    """Run a daemon with the base key trigpoint/test; its end is orderly, or the test fails."""
    config = Config(map=map_, source=McapConfig(type="mcap", path=map_), zenoh=zenoh_)
    stop, loops = asyncio.Event(), list[asyncio.AbstractEventLoop]()
    failures: list[BaseException] = []
    with MapReader.open(map_, model.identity) as reader:
        pipeline = Pipeline(Localizer(model, reader), reader, BODY_FROM_CAMERA, "map")
        responder = Responder(config, zenoh_.requests, pipeline)
        requests = RequestQueue(zenoh_.requests, responder.answer)
        sink = ZenohSink(zenoh_, "trigpoint/test", requests)

        async def main() -> None:
            loops.append(asyncio.get_running_loop())
            await serve(camera, pipeline, {"zenoh": sink}, stop, requests=requests)

        def run() -> None:
            try:
                asyncio.run(main())
            except BaseException as error:  # raised again below, where the test sees it
                failures.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield sink
        finally:
            wait_until(lambda: bool(loops or failures))
            with contextlib.suppress(RuntimeError):  # it has ended already
                loops[0].call_soon_threadsafe(stop.set)
            thread.join(TIMEOUT_S)
            sink.close()
    assert not thread.is_alive()
    if failures:
        raise failures[0]


def wait_until(is_true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not is_true():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def open_session(**settings: Any) -> zenoh.Session:
    """Open a session that finds nobody by itself; `listen__endpoints` is listen/endpoints."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, value in settings.items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


def connect(port: int, **settings: Any) -> zenoh.Session:
    return open_session(mode="client", connect__endpoints=[f"tcp/127.0.0.1:{port}"], **settings)


def get(
    session: zenoh.Session, selector: str | zenoh.Selector, payload: bytes = b"", encoding: str = ""
) -> list[tuple[bool, str]]:
    """Return of each reply whether it is good and its text."""
    replies = session.get(selector, payload=payload, encoding=encoding or None, timeout=TIMEOUT_S)
    texts = []
    for reply in replies:
        if reply.ok is not None:
            texts.append((True, reply.ok.payload.to_bytes().decode(errors="replace")))
        elif reply.err is not None:
            texts.append((False, reply.err.payload.to_string()))
    return texts
