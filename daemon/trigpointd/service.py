"""The daemon: source to slot to localizer to sinks, from start to an orderly stop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field

from trigpoint.database.reader import MapReader
from trigpoint.errors import SourceError, TrigpointError
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpointd.config import Config
from trigpointd.latest import Latest
from trigpointd.pipeline import Output, Pipeline
from trigpointd.sd_notify import notify
from trigpointd.sinks.base import Sink
from trigpointd.sinks.mcap import McapLog
from trigpointd.sinks.zenoh import ZenohSink
from trigpointd.sources.base import Captured, Source
from trigpointd.sources.mcap import McapSource

_log = logging.getLogger(__name__)


@dataclass
class Totals:
    """What became of the frames."""

    outcomes: Counter[str] = field(default_factory=Counter)
    num_dropped: int = 0

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {name}" for name, count in sorted(self.outcomes.items()))
        return f"{counts or 'no frames'}, {self.num_dropped} dropped"


def run(config: Config, extra_sinks: Sequence[Sink] = ()) -> Totals:
    """Run until the recording ends or SIGTERM or SIGINT comes; everything is closed in order."""
    with ExitStack() as stack:
        pipeline = stack.enter_context(open_pipeline(config))
        source = open_source(config)
        sinks = list(extra_sinks)
        for sink in extra_sinks:
            stack.callback(sink.close)
        if config.log is not None:
            log = McapLog(
                config.log.path,
                config.base_key,
                frames=config.log.frames,
                overwrite=config.log.overwrite,
            )
            stack.callback(log.close)
            sinks.append(log)
        if config.zenoh is not None:
            zenoh = ZenohSink(config.zenoh, config.base_key)
            stack.callback(zenoh.close)
            sinks.append(zenoh)
            wait_s = config.zenoh.wait_for_subscriber_s
            if wait_s > 0 and not zenoh.wait_for_subscriber(wait_s):
                _log.warning("nobody has subscribed to the poses in %g s; going on", wait_s)
        return asyncio.run(_run_until_signal(source, pipeline, sinks))


@contextlib.contextmanager
def open_pipeline(config: Config) -> Iterator[Pipeline]:
    """Load the network and open the map."""
    model = FeatureModel.load(config.model.path, num_threads=config.model.num_threads)
    with MapReader.open(config.map, model.identity) as reader:
        localizer = Localizer(model, reader, config.localizer, clock=time.perf_counter)
        yield Pipeline(localizer, reader, config.camera.body_from_camera, config.map_frame)


def open_source(config: Config) -> Source:
    """Open the camera or the recording."""
    source = config.source
    return McapSource(source.path, image_topic=source.image_topic, rate=source.rate)


async def _run_until_signal(source: Source, pipeline: Pipeline, sinks: Sequence[Sink]) -> Totals:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    notify("READY=1")
    _log.info("localizing")
    try:
        return await serve(source, pipeline, sinks, stop)
    finally:
        notify("STOPPING=1")


async def serve(
    source: Source, pipeline: Pipeline, sinks: Sequence[Sink], stop: asyncio.Event
) -> Totals:
    """Localize frames until the source ends or `stop` is set; what is in work is published."""
    slot = Latest[Captured](lossless=not source.live)
    totals = Totals()
    try:
        async with asyncio.TaskGroup() as group:
            feeding = group.create_task(_feed(source, slot))
            stopping = group.create_task(_cancel_on(stop, feeding))
            await _localize(slot, pipeline, list(sinks), totals)
            stopping.cancel()
    finally:
        await source.close()
    if not feeding.cancelled() and (error := feeding.result()) is not None:
        raise error
    return totals


async def _feed(source: Source, slot: Latest[Captured]) -> SourceError | None:
    """Bring frames to the slot; a source that fails ends the stream, after what it brought."""
    try:
        async with contextlib.aclosing(source.frames()) as frames:
            async for captured in frames:
                await slot.put(captured)
    except SourceError as error:
        return error
    finally:
        await slot.close()
    return None


async def _cancel_on(stop: asyncio.Event, task: asyncio.Task[SourceError | None]) -> None:
    await stop.wait()
    _log.info("stopping")
    task.cancel()


async def _localize(
    slot: Latest[Captured], pipeline: Pipeline, sinks: list[Sink], totals: Totals
) -> None:
    while (captured := await slot.get()) is not None:
        output = await asyncio.to_thread(pipeline.process, captured, slot.num_dropped)
        _publish(sinks, output)
        totals.outcomes[output.outcome] += 1
        totals.num_dropped = slot.num_dropped


def _publish(sinks: list[Sink], output: Output) -> None:
    """Hand an output to every sink; one that fails is left out from then on, and said so."""
    for sink in list(sinks):
        try:
            sink.publish(output)
        except TrigpointError as error:
            _log.error("%s; going on without it", error)
            sinks.remove(sink)
