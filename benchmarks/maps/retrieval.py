"""Retrieval in maps of up to a million images: time, what is found, memory."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from benchmarks.localizer.__main__ import say
from benchmarks.maps.rows import Places
from trigpoint.camera import Camera
from trigpoint.database.index import build_index
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import LocalFeatures, ModelIdentity
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint_db.experiments.tables import markdown

Array32 = NDArray[np.float32]

K, NUM_QUERIES, COMMIT_EVERY = 20, 300, 10_000
CAMERA = Camera("PINHOLE", 640, 480, (460.0, 460.0, 319.5, 239.5))


def report(surveys: Sequence[Array32], sizes: Sequence[int]) -> str:
    """Tabulate scan and index, by the number of images."""
    places, rows = Places(surveys), []
    for size in sizes:
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "map.tpmap"
            made, queries = places.make(size, NUM_QUERIES, seed=size)
            make_map(path, made)
            del made
            scanned, *numbers = in_own_process(search_all, path, queries)
            rows.append([f"{size:,}", "scan", "", "", *tell(*numbers), ""])
            before, start = path.stat().st_size, time.perf_counter()
            in_own_process(build_index, path)
            spent = time.perf_counter() - start
            bytes_per_row = (path.stat().st_size - before) / size
            indexed, *numbers = in_own_process(search_all, path, queries)
            recall = np.mean([np.isin(a, b).mean() for a, b in zip(scanned, indexed, strict=True)])
            row = [f"{size:,}", "index", f"{spent:.0f}", f"{bytes_per_row:.0f}"]
            rows.append([*row, *tell(*numbers), f"{recall:.3f}"])
            say(f"{size:,} images: {rows[-2:]}")
    header = [
        "images", "", "built in (s)", "bytes an image", "median (ms)", "p99", "diverse, median",
        "resident (MB)", "recall@20",
    ]  # fmt: skip
    return markdown(header, rows, num_words=2)


def tell(alike_ms: list[float], diverse_ms: list[float], resident_mb: float) -> list[str]:
    """Write the numbers of `search_all`."""
    numbers = np.median(alike_ms), np.quantile(alike_ms, 0.99), np.median(diverse_ms)
    return [*(f"{number:.1f}" for number in numbers), f"{resident_mb:.0f}"]


def make_map(path: Path, rows: Array32) -> None:
    """Write a map of images without features."""
    empty = np.empty((0, 2), np.float32), np.empty((0, 64), np.float32), np.empty(0, np.float32)
    model = ModelIdentity("rows", "0" * 64, descriptor_dim=64, global_dim=rows.shape[1])
    pose = Rigid3.from_center(np.eye(3), np.zeros(3))
    with MapWriter.create(path, model) as writer:
        for i, row in enumerate(rows):
            writer.add(f"{i}", CAMERA, pose, LocalFeatures(*empty, row))
            if i % COMMIT_EVERY == 0:
                writer.commit()


def search_all(
    path: Path, queries: Array32
) -> tuple[list[NDArray[np.intp]], list[float], list[float], float]:
    """Return what is found, times of searches in ms, also diverse ones, and memory in MB.

    The memory is what these searches add, the mapped pages among it.
    """
    threadpoolctl.threadpool_limits(1, user_api="blas")
    before = resident_mb()
    with MapReader.open(path) as reader:
        reader.search(queries[0], K)
        found: list[NDArray[np.intp]] = []
        times: dict[float, list[float]] = {0.0: [], LocalizerOptions().anchor_diversity: []}
        for query in queries:
            for diversity, spent in times.items():
                start = time.perf_counter()
                indices, _ = reader.search(query, K, diversity)
                spent.append((time.perf_counter() - start) * 1e3)
                if diversity == 0:
                    found.append(indices)
        return (found, *times.values(), resident_mb() - before)


def resident_mb() -> float:
    """Read the proportional set size of this process (Linux)."""
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()[1:]
    found = dict(line.split(":", 1) for line in lines)
    return int(found["Pss"].split()[0]) / 1000


def in_own_process(function, *arguments):  # type: ignore[no-untyped-def]
    """Call it in a process which takes its memory with it."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()
