"""Maps built by a real Dask scheduler and two workers, processes on loopback."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.unit.surveys import make_survey
from trigpoint.errors import ConfigError, ModelError
from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map
from trigpoint_db.extraction import Crew, NetworkFiles
from trigpoint_db.importers.base import PosedImage

distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")

from trigpoint_db.cluster import Cluster

NUM_IMAGES = 130
TIMEOUT_S = 60
_QUIET = {"DASK_LOGGING__DISTRIBUTED": "error", "DASK_DISTRIBUTED__SCHEDULER__DASHBOARD": "false"}


def start(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
        cwd=Path(__file__).parents[2],
        env=os.environ | _QUIET,
        stderr=subprocess.DEVNULL,
    )


def start_worker(address: str) -> subprocess.Popen[bytes]:
    return start("dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")


@contextlib.contextmanager
def ended_after(*processes: subprocess.Popen[bytes]) -> Iterator[None]:
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a scheduler that picks its own port."""
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    process = start(
        "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show",
        "--scheduler-file", str(file),
    )  # fmt: skip
    with ended_after(process):
        deadline_s = time.monotonic() + TIMEOUT_S
        while not file.exists() or not file.read_text().endswith("}"):
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"]


def test_the_map_of_a_cluster_with_a_worker_killed_is_that_of_one_process(
    scheduler: str, tmp_path: Path
) -> None:
    model = FeatureModel.load("tiny")
    posed = make_survey(tmp_path, NUM_IMAGES)
    workers = [start_worker(scheduler), start_worker(scheduler)]

    def images() -> Iterator[PosedImage]:
        for index, image in enumerate(posed):
            if index == NUM_IMAGES // 2:
                workers[0].kill()
            yield image

    with ended_after(*workers):
        with distributed.Client(scheduler, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=TIMEOUT_S)
        with Cluster(scheduler) as cluster:
            crew = Crew(cluster, NetworkFiles("tiny", None, model.identity))
            build_map(tmp_path / "m.tpmap", images(), tmp_path / "images", model, crew=crew)
            other = Crew(cluster, NetworkFiles("base", None, model.identity))
            with pytest.raises(ModelError, match=r"the network base on .* is another than here"):
                build_map(tmp_path / "n.tpmap", posed, tmp_path / "images", model, crew=other)
        assert workers[0].poll() == -9
        assert workers[1].poll() is None
    build_map(tmp_path / "alone.tpmap", posed, tmp_path / "images", model)
    assert (tmp_path / "m.tpmap").read_bytes() == (tmp_path / "alone.tpmap").read_bytes()


def test_addresses_without_a_scheduler_or_workers(scheduler: str, port: int) -> None:
    for address in (f"tcp://127.0.0.1:{port}", "nonsense://1", "foo"):
        with pytest.raises(ConfigError, match=f"no Dask scheduler answers at {address}"):
            Cluster(address, patience_s=0.5)
    with pytest.raises(ConfigError, match=f"the scheduler at {scheduler} has no workers"):
        Cluster(scheduler, patience_s=0.5)
