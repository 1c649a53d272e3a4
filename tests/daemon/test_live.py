"""Of a live source the newest frame wins, whatever the localizer takes."""

import asyncio
import contextlib
import json
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import numpy as np

from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import SourceError
from trigpoint.frame import Frame
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpoint_db.demo import CAMERA
from trigpointd.config import Config, LogConfig
from trigpointd.pipeline import Output, Pipeline
from trigpointd.service import Totals, open_source, serve
from trigpointd.sinks.base import Sink
from trigpointd.sinks.recorder import Recorder
from trigpointd.sinks.rolling_log import RollingLog
from trigpointd.sources.base import Captured
from trigpointd.sources.mcap import McapSource

TIMEOUT_S = 60


class Burst:
    """A live camera that gives many frames before the first can be localized, then fails."""

    live = True
    problem = ""

    def __init__(self, num_frames: int, *, fails: bool = False) -> None:
        self._num_frames = num_frames
        self._fails = fails
        self.closed = False

    async def frames(self) -> AsyncGenerator[Captured, None]:
        for i in range(self._num_frames):
            yield Captured(Frame(np.zeros((480, 640), np.uint8), CAMERA, time_ns=i), i)
        if self._fails:
            raise SourceError("the camera is gone")

    async def close(self) -> None:
        self.closed = True


class Collector:
    """A sink that keeps capture times."""

    problem = ""

    def __init__(self) -> None:
        self.times_ns: list[int] = []

    def publish(self, output: Output) -> None:
        self.times_ns.append(output.time_ns)

    def close(self) -> None:
        pass


class Statuses:
    """A sink that keeps the statuses and asks for the end after so many."""

    problem = ""

    def __init__(self, count: int, stop: asyncio.Event) -> None:
        self.received: list[dict[str, Any]] = []
        self._count = count
        self._stop = stop

    def publish(self, output: Output) -> None:
        self.received.append(json.loads(output.status))
        if len(self.received) == self._count:
            self._stop.set()

    def close(self) -> None:
        pass


def serve_burst(
    folder: Path, model: FeatureModel, source: Burst, **sinks: Sink
) -> Totals | Exception:
    with MapWriter.create(folder / "m.tpmap", model.identity):
        pass
    with MapReader.open(folder / "m.tpmap", model.identity) as reader:
        pipeline = Pipeline(Localizer(model, reader), reader, Rigid3.identity(), "map")
        try:
            return asyncio.run(serve(source, pipeline, sinks, asyncio.Event()))
        except SourceError as error:
            return error


def test_the_newest_frame_wins_and_drops_are_counted(tmp_path: Path, model: FeatureModel) -> None:
    source, sink = Burst(50), Collector()
    totals = serve_burst(tmp_path, model, source, sink=sink)
    assert isinstance(totals, Totals)
    assert sink.times_ns[-1] == 49
    assert sink.times_ns == sorted(sink.times_ns)
    assert totals.num_dropped > 0
    assert len(sink.times_ns) + totals.num_dropped == 50
    assert source.closed


def test_a_source_that_fails_is_reported_after_what_it_brought(
    tmp_path: Path, model: FeatureModel
) -> None:
    source, sink = Burst(3, fails=True), Collector()
    error = serve_burst(tmp_path, model, source, sink=sink)
    assert isinstance(error, SourceError)
    assert str(error) == "the camera is gone"
    assert sink.times_ns[-1] == 2
    assert source.closed


def test_while_a_camera_is_away_the_status_says_so(tmp_path: Path, model: FeatureModel) -> None:
    config = Config.model_validate(
        {
            "map": tmp_path / "m.tpmap",
            "source": {
                "type": "v4l2",
                "device": tmp_path / "video0",
                "camera": "PINHOLE 640 480 460 460 320 240",
            },
        }
    )
    with MapWriter.create(config.map, model.identity):
        pass

    async def scenario(pipeline: Pipeline) -> tuple[list[dict[str, Any]], Totals]:
        stop = asyncio.Event()
        sink = Statuses(2, stop)
        async with asyncio.timeout(TIMEOUT_S):
            totals = await serve(open_source(config), pipeline, {"sink": sink}, stop)
        return sink.received, totals

    with MapReader.open(config.map, model.identity) as reader:
        pipeline = Pipeline(Localizer(model, reader), reader, Rigid3.identity(), "map")
        statuses, totals = asyncio.run(scenario(pipeline))
    detail = f"camera {tmp_path}/video0: it is not there: plug it in, or name another source.device"
    for status in statuses:
        assert (status["status"], status["reason"]) == ("FAILED", "NO_FRAMES")
        assert status["problems"] == {"source": detail}
        assert (status["frame"], status["detail"]) == (f"camera {tmp_path}/video0", detail)
    assert statuses[0]["time_ns"] < statuses[1]["time_ns"]
    assert set(totals.outcomes) == {"NO_FRAMES"}


def test_frames_of_a_camera_are_logged_and_replay(tmp_path: Path, model: FeatureModel) -> None:
    recorder = Recorder(RollingLog(LogConfig(path=tmp_path / "log.mcap"), "base"))
    sink = Collector()
    assert isinstance(serve_burst(tmp_path, model, Burst(3), log=recorder, sink=sink), Totals)
    recorder.close()

    async def replay() -> list[Captured]:
        source = McapSource(tmp_path / "log.mcap")
        async with contextlib.aclosing(source.frames()) as frames:
            captured = [c async for c in frames]
        await source.close()
        return captured

    frames = [captured.frame for captured in asyncio.run(replay())]
    # A time of 0 is none in a message: the time of arrival stands in for it, here the same.
    assert [frame.time_ns for frame in frames] == sink.times_ns
    assert all(isinstance(frame, Frame) and frame.camera == CAMERA for frame in frames)
