"""The daemon: source to slot to localizer to sinks, from start to an orderly stop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType

from trigpoint.output import check_output
from trigpointd.config import Config, McapConfig, V4l2Config
from trigpointd.latest import Latest
from trigpointd.pipeline import Output, Pipeline, Report
from trigpointd.reload import Reloads
from trigpointd.request_queue import RequestQueue
from trigpointd.requests import Responder
from trigpointd.sd_notify import Heartbeat, notify
from trigpointd.sinks.base import Sink
from trigpointd.sinks.fanout import Fanout
from trigpointd.sinks.foxglove import FoxgloveSink
from trigpointd.sinks.poses import PoseFile
from trigpointd.sinks.recorder import Recorder
from trigpointd.sinks.rolling_log import RollingLog
from trigpointd.sinks.zenoh import ZenohSink
from trigpointd.sources.base import Captured, Source
from trigpointd.sources.depthai import DepthaiSource
from trigpointd.sources.mcap import McapSource
from trigpointd.sources.supervised import SupervisedSource
from trigpointd.sources.v4l2 import V4l2Source

First = Callable[[], Coroutine[None, None, None]]

_log = logging.getLogger(__name__)


@dataclass
class Totals:
    """What became of the frames."""

    outcomes: Counter[str] = field(default_factory=Counter)
    num_dropped: int = 0

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {name}" for name, count in sorted(self.outcomes.items()))
        return f"{counts or 'no frames'}, {self.num_dropped} dropped"


def run(
    config: Config,
    *,
    read: Callable[[], Config] | None = None,
    poses: Path | None = None,
    extra_sinks: Mapping[str, Sink] = MappingProxyType({}),
) -> Totals:
    """Run until the recording ends or SIGTERM or SIGINT comes; everything is closed in order.

    With `read`, SIGHUP takes up the settings that it returns. `poses` names a file for the poses.
    What is written is opened after all that is read.
    """
    inputs = [config.map]
    if isinstance(config.source, McapConfig):
        inputs.append(config.source.path)
    check_output(poses, *inputs, in_place=True)
    with ExitStack() as stack:
        reloads = stack.enter_context(contextlib.closing(Reloads(config, read)))
        source = open_source(config)
        sinks = dict(extra_sinks)
        first = requests = None
        if config.log is not None:
            recording = not source.live
            log = RollingLog(
                config.log,
                config.base_key,
                inputs=inputs,
                required=recording,
                about={"settings": config.model_dump_json()},
            )
            sinks["log"] = Recorder(log, lossless=recording)
            stack.callback(sinks["log"].close)
        if config.zenoh is not None:
            limits = config.zenoh.requests
            responder = Responder(config, limits, reloads.pipeline)
            reloads.followers.append(responder.use)
            requests = RequestQueue(limits, responder.answer)
            zenoh = ZenohSink(config.zenoh, config.base_key, requests)
            stack.callback(zenoh.close)
            sinks = {"zenoh": zenoh, **sinks}  # poses go out before the log has its work with them
            _log.info("poses go to %s/pose", config.base_key)
            first = partial(zenoh.wait_for_subscriber, config.zenoh.wait_for_subscriber_s)
        if config.foxglove is not None:
            sinks["foxglove"] = FoxgloveSink(config.foxglove, config.base_key)
            stack.callback(sinks["foxglove"].close)
        if poses is not None:
            sinks["poses"] = PoseFile(poses)
            stack.callback(sinks["poses"].close)
        return asyncio.run(_run_until_signal(source, reloads, sinks, first, requests))


def open_source(config: Config) -> McapSource | SupervisedSource:
    """Open the recording; a camera is opened when frames are asked for."""
    source = config.source
    if isinstance(source, McapConfig):
        return McapSource(
            source.path,
            image_topic=source.image_topic,
            rate=source.rate,
            start_s=source.start_s,
            end_s=source.end_s,
            start_time=source.start_time,
            end_time=source.end_time,
            loop=source.loop,
        )
    camera = V4l2Source(source) if isinstance(source, V4l2Config) else DepthaiSource(source)
    return SupervisedSource(camera)


async def _run_until_signal(
    source: Source,
    reloads: Reloads,
    sinks: Mapping[str, Sink],
    first: First | None,
    requests: RequestQueue | None,
) -> Totals:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    if reloads.read is not None:
        loop.add_signal_handler(signal.SIGHUP, reloads.request)
    notify("READY=1")
    _log.info("localizing")
    try:
        return await serve(
            source,
            reloads.pipeline,
            sinks,
            stop,
            first=first,
            reloads=reloads,
            requests=requests,
        )
    finally:
        notify("STOPPING=1")


async def serve(
    source: Source,
    pipeline: Pipeline,
    sinks: Mapping[str, Sink],
    stop: asyncio.Event,
    *,
    first: First | None = None,
    reloads: Reloads | None = None,
    requests: RequestQueue | None = None,
) -> Totals:
    """Localize frames until the source ends or `stop` is set; what is in work is published.

    The source is not asked for frames before `first` is done. Requests take turns with frames:
    asyncio's locks are fair, so that neither waits for more than one of the others.
    """
    slot = Latest[Captured](lossless=not source.live)
    totals = Totals()
    feeding = asyncio.create_task(_feed(source, slot, first))
    stopping = asyncio.create_task(_cancel_on(stop, feeding))
    turn = asyncio.Lock()
    answering = None if requests is None else asyncio.create_task(requests.serve(turn))
    try:
        await _localize(source, slot, pipeline, sinks, totals, turn, reloads)
    finally:
        if requests is not None and answering is not None:
            requests.close()
            await answering  # not to leave while the pipeline is in use
        stopping.cancel()
        feeding.cancel()
        await asyncio.wait([feeding])
        await source.close()
    if not feeding.cancelled():
        feeding.result()  # raises what ended the source
    return totals


async def _feed(source: Source, slot: Latest[Captured], first: First | None) -> None:
    """Bring frames to the slot; a source that fails ends the stream, after what it brought."""
    try:
        if first is not None:
            await first()
        async with contextlib.aclosing(source.frames()) as frames:
            async for captured in frames:
                await slot.put(captured)
    finally:
        await slot.close()


async def _cancel_on(stop: asyncio.Event, task: asyncio.Task[None]) -> None:
    await stop.wait()
    _log.info("stopping")
    task.cancel()


async def _localize(
    source: Source,
    slot: Latest[Captured],
    pipeline: Pipeline,
    sinks: Mapping[str, Sink],
    totals: Totals,
    turn: asyncio.Lock,
    reloads: Reloads | None,
) -> None:
    outlets = Fanout(sinks, required=not source.live)
    heartbeat = Heartbeat()
    while True:
        if reloads is not None and reloads.is_due:
            async with turn:
                pipeline = await asyncio.to_thread(reloads.reload)
        heartbeat.beat(totals, _problems(source, pipeline, outlets))
        try:
            async with asyncio.timeout(heartbeat.period_s):
                if not await slot.wait():
                    return
        except TimeoutError:
            continue
        async with turn:
            captured = await slot.get()
            assert captured is not None
            report = partial(_report, source, slot, pipeline, outlets)
            # Published by the same thread: to wake another one takes longer than to publish.
            output = await asyncio.to_thread(_process, pipeline, captured, report, outlets)
        totals.outcomes[output.outcome] += 1
        totals.num_dropped = slot.num_dropped
        heartbeat.frame(output.outcome)
        if reloads is not None:
            reloads.review(output.outcome)


def _process(pipeline: Pipeline, captured: Captured, report: Report, outlets: Fanout) -> Output:
    output = pipeline.process(captured, report)
    outlets.publish(output)
    return output


def _problems(source: Source, pipeline: Pipeline, outlets: Fanout) -> dict[str, str]:
    """Say what does not work as it should, by the part of the daemon."""
    problems = {"source": source.problem, "map": pipeline.map_problem, **outlets.problems}
    return {name: problem for name, problem in problems.items() if problem}


def _report(
    source: Source,
    slot: Latest[Captured],
    pipeline: Pipeline,
    outlets: Fanout,
    captured: Captured,
) -> dict[str, object]:
    """Say how the daemon is, as a frame's status is written."""
    report: dict[str, object] = {
        "num_dropped": slot.num_dropped,
        "problems": _problems(source, pipeline, outlets),
    }
    if source.live:  # of a recording, the age says nothing
        report["age_ms"] = round((time.time_ns() - captured.frame.time_ns) / 1e6, 3)
    recorder = outlets.sinks.get("log")
    if isinstance(recorder, Recorder):
        report["num_unlogged"] = recorder.num_unlogged
    return report
