"""How many images a second a map is built with: this process, processes, a local Dask cluster.

    python benchmarks/building.py SOURCE [--jobs 2] [--images N]

Prints a Markdown table. The times have the start of the workers in them, which takes seconds; the
cluster of as many processes is left out where Dask, the extra `cluster`, is not installed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

from benchmarks.stage_times import describe_machine
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map
from trigpoint_db.extraction import Crew, NetworkFiles, open_crew
from trigpoint_db.importers.registry import read_dataset


@contextmanager
def open_local_cluster(number: int, network: NetworkFiles) -> Iterator[Crew | None]:
    """Start a scheduler and workers with a thread each, and use them as any other cluster."""
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=number, threads_per_worker=1, dashboard_address=None) as local,
        open_crew(1, local.scheduler_address, network) as crew,
    ):
        yield crew


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("source", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--images", type=int, default=400, help="so many of them")
    arguments = parser.parse_args()
    dataset, jobs = read_dataset(arguments.source), arguments.jobs
    posed = dataset.mapped[: arguments.images]
    model = FeatureModel.load()
    network = NetworkFiles("base", None, model.identity)
    ways = {
        "this process": lambda: open_crew(1, None, network),
        f"`--jobs {jobs}`": lambda: open_crew(jobs, None, network),
    }
    if find_spec("distributed") is None:
        print("without the cluster: Dask is not installed\n")
    else:
        ways[f"`--cluster`, {jobs} workers here"] = lambda: open_local_cluster(jobs, network)
    print(f"{len(posed)} images of {arguments.source.name}; {describe_machine()}\n")
    print("| who | seconds | images/s |\n|---|---|---|")
    maps = set[bytes]()
    for who, open_ in ways.items():
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            began_s = time.perf_counter()
            crew = stack.enter_context(open_())
            path = Path(folder) / "m.tpmap"
            build_map(path, posed, dataset.images, model, crew=crew)
            taken_s = time.perf_counter() - began_s
            maps.add(path.read_bytes())
        print(f"| {who} | {taken_s:.1f} | {len(posed) / taken_s:.1f} |", flush=True)
    if len(maps) > 1:
        raise SystemExit("the maps differ")


if __name__ == "__main__":
    main()
