"""How long the daemon's stages took, from the status messages in its log."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from trigpoint.errors import ConfigError
from trigpoint_db.statuses import read_statuses

TOTAL = "total"


def read_stage_times(log: Path) -> dict[str, list[float]]:
    """Read the times in ms of each stage, and of the frames on the whole under `TOTAL`.

    A frame counts for the stages that it reached; a frame that reached none does not count. Its
    total is the daemon's `latency_ms`, and the sum of its stages where there is none. A log that
    is still being written, or was cut off, is read as far as it is whole.
    """
    times: dict[str, list[float]] = {}
    totals: list[float] = []
    for topic, data in read_statuses(log):
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
