"""A long run of the daemon, with all that befalls it, and whether memory and latency stay flat.

    python -m benchmarks.daemon.soak DEMO FOLDER [--seconds 600] [--fps 30]

DEMO is a folder as `trigpoint-db demo` makes it; FOLDER is emptied, and takes map, film and log.
The camera is faster than the localizer, and is unplugged now and then; the map is changed, peers
ask for things, the settings are taken up anew, the log goes from part to part and loses its oldest.
Ends with 1 where memory, threads or open files clearly grow.
"""

from __future__ import annotations

import argparse
import json
import sched
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zenoh

from benchmarks.daemon.daemon import BASE_KEY, Process, Setup, check_alive, running, subscriber
from benchmarks.daemon.growth import Slope, fifth, fit_slope, has_risen
from benchmarks.stage_times import describe_machine
from trigpoint.errors import TrigpointError
from trigpoint_db.demo import BODY_FROM_CAMERA, CAMERA
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.poses import read_poses

SAMPLE_S, REQUEST_S, UNPLUG_S, MAP_S, RELOAD_S = 1.0, 10.0, 30.0, 45.0, 10.0
UNPLUGGED_S = 2.0
TOTALS = ("num_dropped", "num_missed", "num_unlogged")
PART_MB, KEPT_MB = 50, 1000  # of the log
MIN_SAMPLES = 50
ENVIRONMENT = {"MALLOC_ARENA_MAX": "2"}  # as systemd/trigpointd.service has it
TIMEOUT_S = 30.0
# The service may take so much (MemoryHigh=); growth that reaches it in a month is too much.
MEMORY_MB, MONTH_H = 768, 30 * 24


@dataclass
class Records:
    """What was seen of a run."""

    samples: list[dict[str, float]] = field(default_factory=list)  # a second
    latencies_ms: list[float] = field(default_factory=list)  # a frame: by its status
    ages_ms: list[float] = field(default_factory=list)  # from its time stamp to its status here
    outcomes: Counter[str] = field(default_factory=Counter)  # of frames
    totals: dict[str, int] = field(default_factory=dict)  # by the last status
    events: Counter[str] = field(default_factory=Counter)

    def receive(self, kind: str, payload: bytes, now_ns: int) -> None:
        """Keep of a status what is reported."""
        if kind == "status":
            status = json.loads(payload)
            self.outcomes[status["reason"] or status["status"]] += 1
            self.latencies_ms.append(status["latency_ms"])
            self.ages_ms.append((now_ns - status["time_ns"]) / 1e6)
            self.totals = {name: status[name] for name in TOTALS}

    def numbers(self, name: str) -> list[float]:
        """Return one of what was sampled."""
        return [sample[name] for sample in self.samples]


class Trouble:
    """What befalls a daemon."""

    def __init__(
        self, setup: Setup, process: Process, session: zenoh.Session, records: Records
    ) -> None:
        self._setup, self._process, self._session, self._records = setup, process, session, records
        self._unplugged = setup.folder / "unplugged"
        self._picture = min((setup.demo / "flight").glob("*.jpg")).read_bytes()
        poses = read_poses(setup.demo / "truth.txt")  # body_from_world
        cam_from_world = BODY_FROM_CAMERA.inverse() @ poses[min(poses)]
        numbers = (*cam_from_world.quaternion, *cam_from_world.t)
        self._pose = " ".join(f"{number:.9g}" for number in numbers)

    def sample(self) -> None:
        """Take note of what the process holds."""
        check_alive(self._process)
        self._records.samples.append(_sample(self._process.pid))

    def unplug(self) -> None:
        """Take the camera away."""
        self._setup.film.rename(self._unplugged)
        self._records.events["camera unplugged"] += 1

    def plug_in(self) -> None:
        """Bring the camera back."""
        self._unplugged.rename(self._setup.film)

    def ask(self) -> None:
        """Send each kind of request."""
        self._get("config")
        self._get("map")
        self._get("localize", {"camera": CAMERA.to_text()}, self._picture)

    def change_map(self) -> None:
        """Add an image, and remove it."""
        pose = {"camera": CAMERA.to_text(), "cam_from_world": self._pose}
        self._get("map", {"action": "add", "name": "soak", **pose}, self._picture)
        self._get("map", {"action": "remove", "name": "soak"})

    def reload(self) -> None:
        """Have the settings, networks and map taken up anew."""
        self._process.send_signal(signal.SIGHUP)
        self._records.events["reload asked for"] += 1

    def _get(
        self, key: str, parameters: dict[str, str] | None = None, payload: bytes = b""
    ) -> None:
        selector = zenoh.Selector(f"{BASE_KEY}/{key}", parameters or {})
        replies = self._session.get(
            selector, payload=payload, encoding="image/jpeg", timeout=TIMEOUT_S
        )
        good = [reply.ok is not None for reply in replies]
        self._records.events["request answered" if any(good) else "request refused"] += 1


def run(setup: Setup, seconds: float) -> Records:
    """Run the daemon for so long; each trouble comes twice at least."""
    records = Records()
    with subscriber(records.receive) as (session, port):
        settings = setup.prepare(port)
        with running(settings, "benchmarks.daemon.film", **ENVIRONMENT) as process:
            while not records.latencies_ms:
                check_alive(process)
                time.sleep(0.1)
            trouble = Trouble(setup, process, session, records)
            scheduler = sched.scheduler(time.monotonic)
            end_s = time.monotonic() + seconds

            def every(period_s: float, action: Callable[[], None], after_s: float = 0.0) -> None:
                due_s = time.monotonic() + min(period_s, seconds / 3) + after_s
                while due_s < end_s:
                    scheduler.enterabs(due_s, 0, action)
                    due_s += min(period_s, seconds / 3)

            every(min(SAMPLE_S, seconds / MIN_SAMPLES), trouble.sample)
            every(REQUEST_S, trouble.ask)
            every(UNPLUG_S, trouble.unplug)
            every(UNPLUG_S, trouble.plug_in, UNPLUGGED_S)
            every(MAP_S, trouble.change_map)
            every(RELOAD_S, trouble.reload)
            scheduler.run()
    return records


def _sample(pid: int) -> dict[str, float]:
    """Ask the kernel what a process holds (Linux): MB of memory, threads, open files."""
    folder = Path("/proc") / str(pid)
    lines = (folder / "smaps_rollup").read_text().splitlines()[1:]
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for line in lines}
    return {
        "time_s": time.monotonic(),
        **{name: kilobytes[name] / 1024 for name in ("Rss", "Pss", "Anonymous")},
        "threads": sum(1 for _ in (folder / "task").iterdir()),
        "files": sum(1 for _ in (folder / "fd").iterdir()),
    }


def find_growth(records: Records) -> list[str]:
    """Say what clearly grows after the first fifth; nothing of memory in a run too short."""
    found = [
        f"{name} grow: {fifth(records.numbers(name), 4).min():.0f} at least in the last fifth"
        for name in ("threads", "files")
        if has_risen(records.numbers(name))
    ]
    own_mb = fifth(records.numbers("Anonymous"), 4).mean()
    limit = (MEMORY_MB - own_mb) / MONTH_H
    slope = slope_of(records, "Anonymous")
    if slope.exceeds(limit):
        found.append(f"memory grows by {slope} MB/h, more than the {limit:.1f} MB/h of a month")
    return found


def slope_of(records: Records, name: str) -> Slope:
    """Fit what was sampled, after the first fifth."""
    start = len(records.samples) // 5
    return fit_slope(records.numbers("time_s")[start:], records.numbers(name)[start:])


def report(records: Records) -> str:
    """Lay out how it went, first fifth beside last."""
    rows = []
    for name, title in (
        ("Anonymous", "own memory (anonymous, MB)"),
        ("Pss", "with its share of files and libraries (PSS, MB)"),
        ("Rss", "resident in all (RSS, MB)"),
    ):
        first, last = (f"{fifth(records.numbers(name), i).mean():.1f}" for i in (0, 4))
        rows.append([title, first, last, f"{slope_of(records, name)} MB/h"])
    for name in ("threads", "files"):
        parts = [fifth(records.numbers(name), i) for i in (0, 4)]
        rows.append([name, *(f"{part.min():.0f} to {part.max():.0f}" for part in parts), ""])
    for title, times_ms in (
        ("localizing a frame (ms), p50 / p99", records.latencies_ms),
        ("time stamp to status received (ms), p50 / p99", records.ages_ms),
    ):
        parts = [np.percentile(fifth(times_ms, i), (50, 99)) for i in (0, 4)]
        rows.append([title, *(f"{p50:.1f} / {p99:.1f}" for p50, p99 in parts), ""])
    counts = {**records.outcomes, **records.totals, **records.events}
    table = markdown(["", "first fifth", "last fifth", "slope after the first"], rows)
    return f"{table}\n\n" + ", ".join(f"{name}: {count}" for name, count in counts.items())


def main() -> None:
    """Run, print, and fail where something grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("demo", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--fps", type=float, default=30.0)
    arguments = parser.parse_args()
    try:
        records = run(
            make_setup(arguments.demo, arguments.folder, arguments.fps), arguments.seconds
        )
    except TrigpointError as error:
        sys.exit(str(error))
    print(f"{describe_machine()}; {arguments.seconds:g} s at {arguments.fps:g} frames a second\n")
    print(report(records))
    if growing := find_growth(records):
        sys.exit("\n".join(growing))


def make_setup(demo: Path, folder: Path, fps: float) -> Setup:
    """Log so that parts go soon, and allow all requests."""
    free_mb = shutil.disk_usage(demo).free / 1e6
    log = {"max_part_mb": PART_MB, "min_free_mb": max(0.0, free_mb - KEPT_MB)}
    return Setup(demo, folder, "YUYV", fps, log, ("localize", "map", "change_map", "config"))


if __name__ == "__main__":
    main()
