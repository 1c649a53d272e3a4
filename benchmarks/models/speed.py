"""How long networks take on one thread, run in turn, so that a slow moment slows all."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.models.edgepoint2 import open_session
from benchmarks.models.methods import BASELINE, NUM_KEYPOINTS, Method
from trigpoint_db.experiments.tables import markdown

SIZE = (640, 480)
WARM_UP = 3
ROUNDS = 40

CAPTION = f"""Medians of {ROUNDS} runs at {SIZE[0]} x {SIZE[1]} px on one thread, all in turn: the
network alone, and the way from the image to its {NUM_KEYPOINTS} keypoints and descriptors."""


def measure(methods: Sequence[Method], image: NDArray[np.uint8]) -> dict[str, dict[str, float]]:
    """Measure the median time in ms of every network alone, and of the whole extraction."""
    image = np.asarray(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA), np.uint8)
    rng = np.random.default_rng(0)
    tasks: dict[tuple[str, str], Callable[[], Any]] = {}
    for method in methods:
        extractor = method.open()
        tasks[method.name, "extract_ms"] = lambda e=extractor: e.extract(image, NUM_KEYPOINTS)
        if method.path is not None:
            session = open_session(method.path)
            node = session.get_inputs()[0]
            free = (1, 1, *image.shape)
            shape = [s if isinstance(s, int) else f for s, f in zip(node.shape, free, strict=True)]
            feed = {node.name: rng.standard_normal(shape, np.float32)}
            tasks[method.name, "network_ms"] = lambda s=session, f=feed: s.run(None, f)
    times = {key: _time_all(task, WARM_UP)[:0] for key, task in tasks.items()}
    for _ in range(ROUNDS):
        for key, task in tasks.items():
            times[key] += _time_all(task, 1)
    found: dict[str, dict[str, float]] = {method.name: {} for method in methods}
    for (name, what), elapsed in times.items():
        found[name][what] = float(np.median(elapsed))
    return found


def _time_all(task: Callable[[], Any], count: int) -> list[float]:
    elapsed = []
    for _ in range(count):
        start = time.perf_counter()
        task()
        elapsed.append((time.perf_counter() - start) * 1e3)
    return elapsed


def tabulate(found: dict[str, dict[str, float]]) -> str:
    """Lay out times and their ratios to the baseline's."""
    baseline = found.get(BASELINE, {})
    rows = []
    for name, times in found.items():
        row = [name]
        for what in ("network_ms", "extract_ms"):
            row.append(f"{times[what]:.1f}" if what in times else "-")
            known = what in times and what in baseline
            row.append(f"{times[what] / baseline[what]:.2f}" if known else "-")
        rows.append(row)
    return markdown(["", "network (ms)", "/ E64's", "extract (ms)", "/ E64's"], rows)
