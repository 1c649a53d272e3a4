"""The daemon: source to slot to localizer to sinks, from start to an orderly stop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from trigpoint.database.reader import MapReader
from trigpoint.errors import TrigpointError
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import load_matcher
from trigpoint.output import check_output
from trigpointd.config import Config
from trigpointd.latest import Latest
from trigpointd.pipeline import Output, Pipeline
from trigpointd.request_queue import RequestQueue
from trigpointd.requests import Responder
from trigpointd.sd_notify import notify
from trigpointd.sinks.base import Sink
from trigpointd.sinks.mcap import McapLog
from trigpointd.sinks.poses import PoseFile
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


def run(config: Config, *, poses: Path | None = None, extra_sinks: Sequence[Sink] = ()) -> Totals:
    """Run until the recording ends or SIGTERM or SIGINT comes; everything is closed in order.

    `poses` names a file for the poses. What is written is opened after all that is read.
    """
    inputs = (config.map, config.source.path)
    check_output(poses, *inputs)
    if config.log is not None:
        check_output(config.log.path, *inputs)
    with ExitStack() as stack:
        pipeline = stack.enter_context(open_pipeline(config))
        source = open_source(config)
        sinks = list(extra_sinks)
        first = requests = None
        if config.zenoh is not None:
            limits = config.zenoh.requests
            requests = RequestQueue(limits, Responder(config, limits, pipeline).answer)
            zenoh = ZenohSink(config.zenoh, config.base_key, requests)
            stack.callback(zenoh.close)
            sinks.append(zenoh)
            _log.info("poses go to %s/pose", config.base_key)
            first = partial(zenoh.wait_for_subscriber, config.zenoh.wait_for_subscriber_s)
        if poses is not None:
            sinks.append(PoseFile(poses))
            stack.callback(sinks[-1].close)
        if config.log is not None:
            sinks.append(McapLog.from_config(config.log, config.base_key))
            stack.callback(sinks[-1].close)
        return asyncio.run(_run_until_signal(source, pipeline, sinks, first, requests))


@contextlib.contextmanager
def open_pipeline(config: Config) -> Iterator[Pipeline]:
    """Load the networks and open the map."""
    settings = config.model
    model = FeatureModel.load(
        settings.network, retrieval=settings.retrieval, num_threads=settings.num_threads
    )
    matcher = load_matcher(
        settings.matcher, model.identity.descriptor_dim, num_threads=settings.num_threads
    )
    with MapReader.open(config.map, model.identity) as reader:
        localizer = Localizer(
            model, reader, config.localizer, clock=time.perf_counter, matcher=matcher
        )
        yield Pipeline(localizer, reader, config.camera.body_from_camera, config.map_frame)


def open_source(config: Config) -> Source:
    """Open the camera or the recording."""
    source = config.source
    return McapSource(source.path, image_topic=source.image_topic, rate=source.rate)


async def _run_until_signal(
    source: Source,
    pipeline: Pipeline,
    sinks: Sequence[Sink],
    first: Callable[[], Coroutine[None, None, None]] | None,
    requests: RequestQueue | None,
) -> Totals:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    notify("READY=1")
    _log.info("localizing")
    try:
        if first is not None:
            await _unless(stop, first())
        return await serve(source, pipeline, sinks, stop, requests)
    finally:
        notify("STOPPING=1")


async def _unless(stop: asyncio.Event, work: Coroutine[None, None, None]) -> None:
    """Do something, but not on once `stop` is set."""
    working = asyncio.create_task(work)
    stopping = asyncio.create_task(stop.wait())
    await asyncio.wait([working, stopping], return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if working.cancel():
        return
    working.result()


async def serve(
    source: Source,
    pipeline: Pipeline,
    sinks: Sequence[Sink],
    stop: asyncio.Event,
    requests: RequestQueue | None = None,
) -> Totals:
    """Localize frames until the source ends or `stop` is set; what is in work is published.

    Requests take turns with frames: asyncio's locks are fair, so that neither waits for more than
    one of the others.
    """
    slot = Latest[Captured](lossless=not source.live)
    totals = Totals()
    feeding = asyncio.create_task(_feed(source, slot))
    stopping = asyncio.create_task(_cancel_on(stop, feeding))
    turn = asyncio.Lock()
    answering = None if requests is None else asyncio.create_task(requests.serve(turn))
    try:
        await _localize(slot, pipeline, list(sinks), totals, turn)
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


async def _feed(source: Source, slot: Latest[Captured]) -> None:
    """Bring frames to the slot; a source that fails ends the stream, after what it brought."""
    try:
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
) -> None:
    while await slot.wait():
        async with turn:
            captured = await slot.get()
            assert captured is not None
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
