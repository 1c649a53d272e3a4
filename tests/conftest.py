"""What tests share: the demo's world, made once a session, and the real data, where present."""

import fcntl
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pytest
from hypothesis import settings

from trigpoint.models.features import FeatureModel
from trigpoint_db.build import build_map
from trigpoint_db.calibrate import calibrate_map
from trigpoint_db.demo import make_demo

T = TypeVar("T")
# Machines are shared. Runs draw the same examples; with `--hypothesis-profile untimed` new ones.
settings.register_profile("untimed", deadline=None)
settings.register_profile("repeatable", settings.get_profile("untimed"), derandomize=True)
settings.load_profile("repeatable")
DATA = Path(__file__).parents[1].parent / "shared" / "data"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--golden", action="store_true", help="re-record the golden poses")


@dataclass(frozen=True)
class Demo:
    """A rendered room, as `trigpoint-db demo` leaves it."""

    folder: Path

    @property
    def map(self) -> Path:
        return self.folder / "map.tpmap"

    @property
    def recording(self) -> Path:
        return self.folder / "flight.mcap"

    @property
    def truth(self) -> Path:
        return self.folder / "truth.txt"


def without_progress(items: Iterator[T], what: str, total: int) -> Iterator[T]:
    return items


@pytest.fixture(scope="session")
def model() -> FeatureModel:
    return FeatureModel.load()


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory, worker_id: str, model: FeatureModel) -> Demo:
    shared = tmp_path_factory.getbasetemp()
    if worker_id != "master":  # one of several processes; the first to come makes it for all
        shared = shared.parent
    folder, made = shared / "demo", shared / "demo-made"
    with (shared / "demo-lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            survey = make_demo(folder, num_survey=140, num_flight=16, progress=without_progress)
            build_map(folder / "map.tpmap", survey, folder / "survey", model)
            calibrate_map(folder / "map.tpmap", model)
            made.touch()
    return Demo(folder)


@pytest.fixture
def port() -> int:
    """A TCP port on loopback that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        number: int = listener.getsockname()[1]
        return number
