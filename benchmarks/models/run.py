"""One run: what is measured on what, by which processes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from benchmarks.models import homographies, localization, poses, retrieval, rotation, speed
from benchmarks.models.methods import Features, Method
from benchmarks.models.surveys import load_survey, measure_visibility
from trigpoint.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Plan:
    """What each method is measured on."""

    sets: list[Path]
    photographs: Path | None
    tables: list[str]
    pairs: poses.Pairs
    overlapping: dict[str, NDArray[np.bool_]]


def measure(method: Method, plan: Plan) -> dict[str, Any]:
    """Fill one method's row of every table but that of the times."""
    features = Features(method)
    surveys = [load_survey(folder) for folder in plan.sets]
    found: dict[str, Any] = {}
    if "pairs" in plan.tables:
        found["pairs"] = poses.measure(features, surveys, plan.pairs)
    if "homographies" in plan.tables and plan.photographs is not None:
        found["homographies"] = homographies.measure(features, plan.photographs)
    if "retrieval" in plan.tables:
        found["retrieval"] = retrieval.measure(
            features, surveys, plan.overlapping, plan.sets, plan.photographs
        )
    if "rotation" in plan.tables and not method.variant:
        found["rotation"] = rotation.measure(features, surveys, plan.pairs)
    if "localization" in plan.tables and method.ours:
        found["localization"] = localization.measure(features.extractor, surveys, plan.sets)
    return found


def prepare_process() -> None:
    """Leave the cores to the processes."""
    cv2.setNumThreads(1)
    threadpoolctl.threadpool_limits(1, user_api="blas")


@contextmanager
def open_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Start processes afresh: OpenCV's threads do not survive a fork."""
    with ProcessPoolExecutor(jobs, get_context("spawn"), prepare_process) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def make_plan(
    data: Path,
    photographs: Path | None,
    tables: list[str],
    num_pairs: int,
    pool: ProcessPoolExecutor,
) -> Plan:
    """Find the sets, and what their images see of one another."""
    folders = [data / name for name in poses.SETS]
    if "retrieval" in tables and data.is_dir():
        folders += sorted(set(data.iterdir()) - set(folders))
    sets = [folder for folder in folders if (folder / "sparse").is_dir()]
    if not sets:
        raise ConfigError(
            f"there is no set in {data}; give a folder that holds one of "
            f"{', '.join(poses.SETS)}, with images/ and sparse/"
        )
    for folder in folders[: len(poses.SETS)]:
        if folder not in sets:
            say(f"{folder.name} is skipped: there is no {folder / 'sparse'}")
    if {"homographies", "retrieval"} & set(tables) and photographs is None:
        say("homographies and SIFT's VLAD are skipped: give --photographs")
    pairs: poses.Pairs = {}
    overlapping = {}
    if {"pairs", "retrieval", "rotation"} & set(tables):
        for folder, visibility in zip(sets, pool.map(measure_visibility, sets), strict=True):
            pairs[folder.name] = visibility.wide_pairs(num_pairs)
            overlapping[folder.name] = visibility.overlapping()
            say(f"{folder.name}: {len(pairs[folder.name])} pairs")
    return Plan(sets, photographs, tables, pairs, overlapping)


def measure_all(
    methods: Sequence[Method], plan: Plan, pool: ProcessPoolExecutor
) -> dict[str, dict[str, Any]]:
    """Measure every method in a process of its own, several at a time: results by table."""
    found: dict[str, dict[str, Any]] = {}
    tasks = {pool.submit(measure, method, plan): method.name for method in methods}
    for task in as_completed(tasks):
        found[tasks[task]] = task.result()
        say(f"{tasks[task]} is done")
    return {
        table: {m.name: found[m.name][table] for m in methods if found[m.name].get(table)}
        for table in plan.tables
    }


def measure_speed(methods: Sequence[Method], plan: Plan) -> dict[str, Any]:
    """Measure the times, here, with nothing beside."""
    prepare_process()
    return speed.measure(methods, load_survey(plan.sets[0]).images[0])


def say(text: str) -> None:
    """Report progress."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)
