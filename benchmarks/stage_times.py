"""Where the time of one query goes: with as many anchors as needed, and with 20 and 50 at once.

    python benchmarks/stage_times.py MAP --images DIR --queries FILE

Prints a Markdown table: median and 99th percentile of each stage over all queries, after a warm-up,
for all three frame by frame in turn, so that a machine that slows down slows them all.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import time
from pathlib import Path

import numpy as np
import onnxruntime
import threadpoolctl

from trigpoint.database.reader import MapReader
from trigpoint.frame import Localized
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint_db.build import read_frame
from trigpoint_db.poses import read_queries

OPTIONS = {
    "as needed": LocalizerOptions(),
    "K=20": LocalizerOptions(num_anchors=20, first_anchors=20),
    "K=50": LocalizerOptions(num_anchors=50, first_anchors=50),
}
ROUNDS = 3


def describe_machine() -> str:
    """Name the processor and the libraries that count."""
    info = Path("/proc/cpuinfo").read_text()
    names = [line.split(":")[1].strip() for line in info.splitlines() if "model name" in line]
    # Instructions that add four 8-bit products at once, which INT8 networks live on.
    dot_products = "" if re.search(r"vnni|asimddp", info) else "no "
    return (
        f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores, "
        f"{dot_products}8-bit dot products (VNNI, dotprod); Python "
        f"{platform.python_version()}, numpy {np.__version__}, onnxruntime "
        f"{onnxruntime.__version__}; one BLAS thread, two network threads"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("map", type=Path)
    parser.add_argument("--images", type=Path, required=True)
    parser.add_argument("--queries", type=Path, required=True)
    parser.add_argument("--model", default="base", help="tiny, base, large, or a file")
    arguments = parser.parse_args()
    threadpoolctl.threadpool_limits(1, user_api="blas")
    network = FeatureModel.load(arguments.model)
    frames = [
        read_frame(arguments.images, query.name, query.camera)
        for query in read_queries(arguments.queries)
    ]
    times: dict[str, dict[str, list[float]]] = {k: {} for k in OPTIONS}
    localized = dict.fromkeys(OPTIONS, 0)
    with MapReader.open(arguments.map, network.identity) as reader:
        localizers = {
            k: Localizer(network, reader, options, time.perf_counter)
            for k, options in OPTIONS.items()
        }
        for localizer in localizers.values():
            localizer.localize(frames[0])
        for frame in frames * ROUNDS:
            for k, localizer in localizers.items():
                start = time.perf_counter()
                result = localizer.localize(frame)
                total = (time.perf_counter() - start) * 1e3
                localized[k] += isinstance(result, Localized)
                for stage, ms in {**result.statistics.stage_ms, "total": total}.items():
                    times[k].setdefault(stage, []).append(ms)
        num_images = len(reader)
    print(f"{describe_machine()}\n")
    print(f"{len(frames)} queries, {ROUNDS} times, {frames[0].camera.width} x", end=" ")
    print(f"{frames[0].camera.height} px, 1024 keypoints, a map of {num_images} images;", end=" ")
    print(", ".join(f"{k}: {n} of {len(frames) * ROUNDS} OK" for k, n in localized.items()))
    print("\n| stage (ms) | " + " | ".join(f"{k}: median | p99" for k in OPTIONS) + " |")
    print("|---|" + "---:|" * 2 * len(OPTIONS))
    for stage in times["as needed"]:
        cells = [
            f"{np.percentile(times[k].get(stage, [0.0]), p):.1f}" for k in OPTIONS for p in (50, 99)
        ]
        print(f"| {stage} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
