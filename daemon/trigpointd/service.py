"""The daemon: source to slot to localizer to sinks, from start to an orderly stop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from trigpoint.errors import TrigpointError
from trigpoint.output import check_output
from trigpointd.config import Config, McapConfig, V4l2Config
from trigpointd.latest import Latest
from trigpointd.pipeline import Output, Pipeline
from trigpointd.reload import Reloads
from trigpointd.request_queue import RequestQueue
from trigpointd.requests import Responder
from trigpointd.sd_notify import Heartbeat, notify
from trigpointd.sinks.base import Sink
from trigpointd.sinks.foxglove import FoxgloveSink
from trigpointd.sinks.poses import PoseFile
from trigpointd.sinks.recorder import Recorder
from trigpointd.sinks.rolling_log import RollingLog
from trigpointd.sinks.zenoh import ZenohSink
from trigpointd.sources.base import Captured, Source
from trigpointd.sources.depthai import DepthaiSource
from trigpointd.sources.mcap import McapSource
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
    extra_sinks: Sequence[Sink] = (),
) -> Totals:
    """Run until the recording ends or SIGTERM or SIGINT comes; everything is closed in order.

    With `read`, SIGHUP takes up the settings that it returns. `poses` names a file for the poses.
    What is written is opened after all that is read.
    """
    inputs = [config.map]
    if isinstance(config.source, McapConfig):
        inputs.append(config.source.path)
    check_output(poses, *inputs)
    with ExitStack() as stack:
        reloads = stack.enter_context(contextlib.closing(Reloads(config, read)))
        source = open_source(config)
        sinks = list(extra_sinks)
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
            sinks.append(Recorder(log, lossless=recording))
            stack.callback(sinks[-1].close)
        if config.zenoh is not None:
            limits = config.zenoh.requests
            responder = Responder(config, limits, reloads.pipeline)
            reloads.followers.append(responder.use)
            requests = RequestQueue(limits, responder.answer)
            zenoh = ZenohSink(config.zenoh, config.base_key, requests)
            stack.callback(zenoh.close)
            sinks.append(zenoh)
            _log.info("poses go to %s/pose", config.base_key)
            first = partial(zenoh.wait_for_subscriber, config.zenoh.wait_for_subscriber_s)
        if config.foxglove is not None:
            sinks.append(FoxgloveSink(config.foxglove, config.base_key))
            stack.callback(sinks[-1].close)
        if poses is not None:
            sinks.append(PoseFile(poses))
            stack.callback(sinks[-1].close)
        return asyncio.run(_run_until_signal(source, reloads, sinks, first, requests))


def open_source(config: Config) -> McapSource | V4l2Source | DepthaiSource:
    """Open the recording; a camera is opened when frames are asked for."""
    source = config.source
    if isinstance(source, McapConfig):
        return McapSource(
            source.path,
            image_topic=source.image_topic,
            rate=source.rate,
            start_s=source.start_s,
            end_s=source.end_s,
            loop=source.loop,
        )
    return V4l2Source(source) if isinstance(source, V4l2Config) else DepthaiSource(source)


async def _run_until_signal(
    source: Source,
    reloads: Reloads,
    sinks: Sequence[Sink],
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
    sinks: Sequence[Sink],
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
        await _localize(slot, pipeline, list(sinks), totals, turn, reloads)
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
    slot: Latest[Captured],
    pipeline: Pipeline,
    sinks: list[Sink],
    totals: Totals,
    turn: asyncio.Lock,
    reloads: Reloads | None,
) -> None:
    heartbeat = Heartbeat()
    while True:
        if reloads is not None and reloads.is_due:
            async with turn:
                pipeline = await asyncio.to_thread(reloads.reload)
        heartbeat.beat(totals)
        try:
            async with asyncio.timeout(heartbeat.period_s):
                if not await slot.wait():
                    return
        except TimeoutError:
            continue
        async with turn:
            captured = await slot.get()
            assert captured is not None
            output = await asyncio.to_thread(
                pipeline.process, captured, slot.num_dropped, _log_report(sinks)
            )
        _publish(sinks, output)
        totals.outcomes[output.outcome] += 1
        totals.num_dropped = slot.num_dropped
        heartbeat.frame(output.outcome)


def _log_report(sinks: list[Sink]) -> dict[str, object]:
    return next((sink.report() for sink in sinks if isinstance(sink, Recorder)), {})


def _publish(sinks: list[Sink], output: Output) -> None:
    """Hand an output to every sink; one that fails is left out from then on, and said so."""
    for sink in list(sinks):
        try:
            sink.publish(output)
        except TrigpointError as error:
            _log.error("%s; going on without it", error)
            sinks.remove(sink)
