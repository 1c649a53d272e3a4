"""What fails, fails alone: it is said once, told in the status, and tried again."""

import asyncio
import json
import logging
import time
from collections.abc import AsyncGenerator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trigpoint.database.writer import MapWriter
from trigpoint.errors import SourceError
from trigpoint.frame import Frame
from trigpoint.models.features import FeatureModel
from trigpoint_db.demo import CAMERA
from trigpointd.config import Config, McapConfig
from trigpointd.pipeline import Output
from trigpointd.reload import Reloads
from trigpointd.service import serve
from trigpointd.sources.base import Captured

NUM_FRAMES = 12


class Camera:
    """Gives black frames, each after the one before has been published."""

    problem = ""

    def __init__(self, *, live: bool = True) -> None:
        self.live = live
        self.published = asyncio.Semaphore(1)

    async def frames(self) -> AsyncGenerator[Captured, None]:
        for _ in range(NUM_FRAMES):
            await self.published.acquire()
            now_ns = time.time_ns()
            yield Captured(Frame(np.zeros((480, 640), np.uint8), CAMERA, now_ns), now_ns)

    async def close(self) -> None:
        pass


class Sink:
    """Keeps statuses, and has a camera go on; raises planned errors, by the frame's number."""

    problem = ""

    def __init__(
        self, camera: Camera | None = None, errors: dict[int, Exception] | None = None
    ) -> None:
        self._camera = camera
        self._errors = errors or {}
        self._num_frames = 0
        self.statuses: list[dict[str, Any]] = []

    def publish(self, output: Output) -> None:
        if self._camera is not None:
            self._camera.published.release()
        self._num_frames += 1
        if error := self._errors.get(self._num_frames):
            raise error
        self.statuses.append(json.loads(output.status))

    def close(self) -> None:
        pass


@pytest.fixture
def reloads(tmp_path: Path, model: FeatureModel) -> Iterator[Reloads]:
    with MapWriter.create(tmp_path / "m.tpmap", model.identity):
        pass
    source = McapConfig(type="mcap", path=tmp_path)
    reloads = Reloads(Config(map=tmp_path / "m.tpmap", source=source), None)
    yield reloads
    reloads.close()


def run(camera: Camera, reloads: Reloads, **sinks: Sink) -> None:
    asyncio.run(serve(camera, reloads.pipeline, sinks, asyncio.Event(), reloads=reloads))


def test_a_sink_that_fails_costs_the_others_nothing_and_is_tried_again(
    reloads: Reloads, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    camera = Camera()
    errors = {2: SourceError("no space"), 3: SourceError("no space"), 4: OSError("a bug")}
    failing, steady = Sink(errors=errors), Sink(camera)
    run(camera, reloads, failing=failing, steady=steady)
    assert len(failing.statuses) == NUM_FRAMES - 3
    problems = [status["problems"].get("failing", "") for status in steady.statuses]
    assert problems[:6] == ["", "", "no space", "no space", "a bug", ""]
    said = [r.message for r in caplog.records if r.name.endswith("fanout")]
    assert said == ["failing fails: no space; the rest goes on", "failing works again"]


def test_what_is_made_of_a_recording_is_whole_or_an_error(reloads: Reloads) -> None:
    camera = Camera(live=False)
    with pytest.raises(SourceError, match="no space"):
        run(camera, reloads, poses=Sink(camera, {2: SourceError("no space")}))


def test_a_localizer_that_fails_frame_after_frame_is_made_anew(
    reloads: Reloads, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    camera = Camera()
    sink = Sink(camera)
    monkeypatch.setattr(reloads.pipeline, "localizer", None)  # whatever is asked of it fails
    run(camera, reloads, sink=sink)
    reasons = [status["reason"] for status in sink.statuses]
    assert reasons == ["INTERNAL_ERROR"] * 5 + ["NO_MAP"] * (NUM_FRAMES - 5)
    said = [record.message for record in caplog.records]
    assert sum("AttributeError" in message for message in said) == 1
    assert sum("a fresh start" in message for message in said) == 1


def test_a_live_frames_age_is_that_at_publishing(reloads: Reloads) -> None:
    camera = Camera()
    sink = Sink(camera)
    before_s = time.time()
    run(camera, reloads, sink=sink)
    passed_ms = (time.time() - before_s) * 1e3
    for status in sink.statuses:
        assert status["latency_ms"] <= status["age_ms"] <= passed_ms
