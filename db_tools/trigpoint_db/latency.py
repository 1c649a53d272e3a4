"""How long the daemon's stages took, from the status messages in its log."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from rich.console import Console
from rich.table import Table

from trigpoint.errors import ConfigError
from trigpoint_db.salvage import DAMAGE

TOTAL = "total"


def read_stage_times(log: Path) -> dict[str, list[float]]:
    """Read the times in ms of each stage, and of the frames on the whole under `TOTAL`.

    A frame counts for the stages that it reached; a frame that reached none does not count. Its
    total is the daemon's `latency_ms`, and the sum of its stages where there is none. A log that
    is still being written, or was cut off, is read as far as it is whole.
    """
    times: dict[str, list[float]] = {}
    totals: list[float] = []
    for topic, data in _read_statuses(log):
        try:
            status = json.loads(data)
            stage_ms = {str(stage): float(ms) for stage, ms in status["stage_ms"].items()}
            total_ms = float(status.get("latency_ms", sum(stage_ms.values())))
        except KeyError:  # a frame that could not be read
            continue
        except (ValueError, TypeError, AttributeError) as error:
            raise ConfigError(
                f"{log}: {data[:80]!r} on {topic} is not a status of trigpointd"
            ) from error
        for stage, ms in stage_ms.items():
            times.setdefault(stage, []).append(ms)
        if stage_ms:
            totals.append(total_ms)
    if not totals:
        raise ConfigError(f"there are no stage times in {log}; give an MCAP log of trigpointd")
    return times | {TOTAL: totals}


def summarize_latency(stage_times: Mapping[str, Sequence[float]]) -> dict[str, dict[str, float]]:
    """Return the median and the 99th percentile of each stage's times in ms."""
    return {
        stage: {"p50": float(np.percentile(ms, 50)), "p99": float(np.percentile(ms, 99))}
        for stage, ms in stage_times.items()
    }


def print_latency(console: Console, stage_times: Mapping[str, Sequence[float]]) -> None:
    """Print the median and the 99th percentile of each stage's times."""
    table = Table(title="latency (ms)")
    table.add_column("stage")
    for heading in ("frames", "p50", "p99"):
        table.add_column(heading, justify="right")
    for stage, ms in summarize_latency(stage_times).items():
        if stage == TOTAL:
            table.add_section()
        table.add_row(stage, str(len(stage_times[stage])), f"{ms['p50']:.1f}", f"{ms['p99']:.1f}")
    console.print(table)


def _read_statuses(log: Path) -> Iterator[tuple[str, bytes]]:
    try:
        with log.open("rb") as stream:
            whole = _is_whole(stream)
            try:
                yield from _statuses(stream)
            except DAMAGE as error:
                if whole:
                    detail = str(error) or type(error).__name__
                    raise ConfigError(
                        f"{log} is damaged ({detail}); try `trigpoint-db recover`"
                    ) from error
    except OSError as error:
        raise ConfigError(f"cannot read {log}: {error.strerror}") from error


def _is_whole(stream: BinaryIO) -> bool:
    """Say whether the file has its end."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - len(MCAP0_MAGIC)))
    end = stream.read()
    stream.seek(0)
    return end == MCAP0_MAGIC


def _statuses(stream: BinaryIO) -> Iterator[tuple[str, bytes]]:
    """Yield topic and data of the JSON messages on topics that end in `/status`."""
    topics: dict[int, str] = {}
    # The one of mcap's readers that gives what there is of a log without an end.
    for record in StreamReader(stream, validate_crcs=True).records:
        if isinstance(record, Channel) and record.message_encoding == "json":
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id, "")
            if topic.endswith("/status"):
                yield topic, record.data
