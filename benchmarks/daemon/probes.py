"""The daemon of `film`, which writes down when what happened to each frame.

    python -m benchmarks.daemon.probes TIMES run --config FILE

At the end, each line of TIMES is what was called, the frame's capture time, and when the call began
and ended, in nanoseconds of the wall clock.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Any

from benchmarks.daemon import film
from trigpoint.localizer import Localizer
from trigpointd.latest import Latest
from trigpointd.messages.images import Image
from trigpointd.pipeline import Pipeline
from trigpointd.sinks.recorder import Recorder
from trigpointd.sinks.rolling_log import RollingLog
from trigpointd.sinks.zenoh import ZenohSink

# What to call each probe, and the capture time of what the method is called with: of an image
# itself, else of its first argument.
_PROBES: dict[str, tuple[Any, str, Callable[..., int]]] = {
    "decode": (Image, "gray", attrgetter("time_ns")),
    "put": (Latest, "put", lambda _, captured: captured.frame.time_ns),
    "process": (Pipeline, "process", lambda _, captured, *more: captured.frame.time_ns),
    "localize": (Localizer, "localize", lambda _, frame, *more: frame.time_ns),
    "record": (Recorder, "publish", lambda _, output: output.time_ns),
    "publish": (ZenohSink, "publish", lambda _, output: output.time_ns),
    "write": (RollingLog, "write", lambda _, output: output.time_ns),
}


def main() -> None:
    """Be the daemon, and write down the times once it has ended."""
    path = Path(sys.argv.pop(1))
    lines: list[str] = []
    for name, (owner, method, time_of) in _PROBES.items():
        setattr(owner, method, _timed(name, getattr(owner, method), time_of, lines))
    try:
        film.main()
    finally:
        path.write_text("\n".join(lines))


def _timed(
    name: str, call: Callable[..., Any], time_of: Callable[..., int], lines: list[str]
) -> Callable[..., Any]:
    @functools.wraps(call)
    def timed(*arguments: Any) -> Any:
        start_ns = time.time_ns()
        try:
            return call(*arguments)
        finally:
            lines.append(f"{name} {time_of(*arguments)} {start_ns} {time.time_ns()}")

    return timed


if __name__ == "__main__":
    main()
