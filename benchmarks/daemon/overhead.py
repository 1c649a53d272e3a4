"""What the daemon adds to the localizer's time, from the camera to a subscriber.

    python -m benchmarks.daemon.overhead DEMO [--frames 1000] [--fps 10] [--output FILE]

DEMO is a folder as `trigpoint-db demo` makes it. Its flight is played as a camera's frames to a
`trigpointd run` of its own process, whose poses this process receives over loopback TCP.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.daemon.daemon import Setup, check_alive, running, subscriber
from benchmarks.stage_times import describe_machine
from trigpoint.errors import TrigpointError
from trigpoint.output import check_output, open_text
from trigpoint_db.experiments.tables import markdown
from trigpointd.messages.cdr import decode_pose

WARM_UP = 30  # frames
PATIENCE_S = 120.0  # for the next pose, on a busy machine
SERVICE_SETTINGS = Path(__file__).parents[2] / "systemd" / "trigpoint.toml"
LOCALIZER, TOTAL, OVERHEAD = "localizer (taken off)", "capture to pose", "**overhead**"
# Where the time goes: from the beginning ("<") or the end (">") of one probe to that of another.
PARTS = {
    "stamp to decoder: wake up, fetch": ("captured", "decode<"),
    "decode to gray": ("decode<", "decode>"),
    "to the slot: checks, message for the log": ("decode>", "put<"),
    "slot to worker thread": ("put<", "process<"),
    "into the localizer: look at the map": ("process<", "localize<"),
    LOCALIZER: ("localize<", "localize>"),
    "encode pose and status": ("localize>", "process>"),
    "to Zenoh": ("process>", "publish<"),
    "publish, transport, wake the subscriber": ("publish<", "received"),
}
BESIDE = {
    "beside it: hand to the log": ("record<", "record>"),
    "beside it: write the log": ("write<", "write>"),
    TOTAL: ("captured", "received"),
}
INTRODUCTION = """# What the daemon adds

{machine}.

    make bench-daemon

From a frame's time stamp to its pose in the hands of a subscriber, less `Localizer.localize`: each
of {frames} poses at {fps:g} frames a second of 640 x 480 px. `trigpointd run` is a process of its
own, with the source of V4L2 cameras (a timer and files stand for the driver,
`benchmarks/daemon/film.py`) and the MCAP log; the subscriber is another one, over loopback TCP. All
times in ms."""


def measure(setup: Setup, num_frames: int) -> dict[str, NDArray[np.float64]]:
    """Return the time (num_frames,) of each part, and of all but the localizer, in ms."""
    received: dict[int, int] = {}  # when, by time of capture

    def receive(kind: str, payload: bytes, now_ns: int) -> None:
        if kind == "pose":
            received[decode_pose(payload).time_ns] = now_ns

    times_path = setup.folder / "times.txt"
    with subscriber(receive) as (_, port):
        settings = setup.prepare(port)
        with running(settings, "benchmarks.daemon.probes", str(times_path.resolve())) as process:
            count, since = 0, time.monotonic()
            while count < WARM_UP + num_frames:
                check_alive(process)
                time.sleep(0.2)
                if len(received) > count:
                    count, since = len(received), time.monotonic()
                elif time.monotonic() - since > PATIENCE_S:
                    raise TrigpointError(
                        f"no pose for {PATIENCE_S:g} s; see the daemon's stderr.txt"
                    )
    times: dict[str, dict[int, int]] = {}
    for line in times_path.read_text().splitlines():
        name, time_ns, start_ns, end_ns = line.split()
        times.setdefault(f"{name}<", {})[int(time_ns)] = int(start_ns)
        times.setdefault(f"{name}>", {})[int(time_ns)] = int(end_ns)
    times["received"] = received
    frames = list(received)[WARM_UP : WARM_UP + num_frames]
    times["captured"] = {time_ns: time_ns for time_ns in frames}
    parts = {
        part: np.array([times[end][frame] - times[start][frame] for frame in frames]) / 1e6
        for part, (start, end) in {**PARTS, **BESIDE}.items()
    }
    return {**parts, OVERHEAD: parts[TOTAL] - parts[LOCALIZER]}


def tabulate(parts: Mapping[str, NDArray[np.float64]]) -> str:
    """Lay out median, 99th percentile and maximum of each part."""
    rows = [
        [part, *(f"{np.percentile(parts[part], p):.2f}" for p in (50, 99, 100))]
        for part in (*PARTS, OVERHEAD, *BESIDE)
    ]
    return markdown(["", "p50", "p99", "max"], rows)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demo", type=Path)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--output", type=Path, help="Markdown")
    arguments = parser.parse_args()
    service_log = tomllib.loads(SERVICE_SETTINGS.read_text())["log"]
    del service_log["path"]
    cases = {
        "YUYV, frames logged": ("YUYV", {}),
        "Motion JPEG, frames logged": ("MJPG", {}),
        "YUYV, the service's log: no frames": ("YUYV", service_log),
    }
    try:
        check_output(arguments.output)
        report = [
            INTRODUCTION.format(
                machine=describe_machine(), frames=arguments.frames, fps=arguments.fps
            )
        ]
        with tempfile.TemporaryDirectory() as scratch:
            for i, (name, (pixel_format, log)) in enumerate(cases.items()):
                folder = Path(scratch) / str(i)
                setup = Setup(arguments.demo, folder, pixel_format, arguments.fps, log)
                report.append(f"## {name}\n\n{tabulate(measure(setup, arguments.frames))}")
        text = "\n\n".join(report) + "\n"
        print(text)
        if arguments.output:
            with open_text(arguments.output) as file:
                file.write(text)
    except TrigpointError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
