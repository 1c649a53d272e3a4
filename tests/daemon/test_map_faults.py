"""What happens to the map's file under a daemon, and how a good map is taken up again."""

import contextlib
import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from tests.conftest import Demo
from tests.daemon.test_service import daemon, write_config
from tests.unit.test_database_overwritten import copy, overwrite
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import Frame, ModelIdentity
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpoint_db.build import build_map
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.colmap import read_model
from trigpointd.pipeline import Pipeline
from trigpointd.sources.base import Captured

Fault = Callable[[Path], AbstractContextManager[object] | None]


def put_directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


@contextlib.contextmanager
def without_rights(path: Path) -> Iterator[None]:
    """Take the permission to read away, also from root, who has it anyway."""
    path.chmod(0)
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65_534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)
        path.chmod(0o644)


def overwrite_by_another_models(path: Path) -> None:
    other = path.with_name("other.tpmap")
    with MapWriter.create(other, ModelIdentity("other", "00", 64, 512)):
        pass
    overwrite(path, other.read_bytes())


def overwrite_behind_the_roots(path: Path) -> None:
    octets = path.read_bytes()
    overwrite(path, octets[:8192] + bytes(len(octets) - 8192))


KEEPING: dict[str, tuple[Fault, str]] = {
    "deleted": (Path.unlink, "no such map"),
    "replaced by a directory": (put_directory, "not a regular file"),
    "without rights": (without_rights, "permission denied"),
}
SPOILING: dict[str, tuple[Fault, str]] = {
    "cut to half": (lambda p: os.truncate(p, p.stat().st_size // 2), "cut short"),
    "cut to nothing": (lambda path: os.truncate(path, 0), "not a Trigpoint map"),
    "zeros": (lambda p: overwrite(p, bytes(p.stat().st_size)), "not a Trigpoint map"),
    "zeros behind the roots": (overwrite_behind_the_roots, "damaged"),
    "another model's": (overwrite_by_another_models, "made with model 'other'"),
}


@dataclass
class Rig:
    """A pipeline on a map of its own, a frame that is localized in it, and another good map."""

    path: Path
    good: Path
    pipeline: Pipeline
    captured: Captured

    def status(self) -> dict[str, Any]:
        loaded: dict[str, Any] = json.loads(self.pipeline.process(self.captured).status)
        return loaded


@pytest.fixture(scope="module")
def good(demo: Demo, model: FeatureModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of other contents, and other commits, than the demo's."""
    path = tmp_path_factory.mktemp("good") / "good.tpmap"
    build_map(path, read_model(demo.folder / "sparse")[:30], demo.folder / "survey", model)
    return path


@pytest.fixture
def rig(demo: Demo, model: FeatureModel, good: Path, tmp_path: Path) -> Iterator[Rig]:
    path = tmp_path / "m.tpmap"
    shutil.copyfile(demo.map, path)
    picture = demo.folder / "survey" / read_model(demo.folder / "sparse")[5].name
    captured = Captured(Frame(read_gray(picture), CAMERA, time_ns=5), 5)
    with MapReader.open(path, model.identity) as reader:
        pipeline = Pipeline(Localizer(model, reader), reader, Rigid3.identity(), "map")
        copied = shutil.copyfile(good, tmp_path / "good.tpmap")
        yield Rig(path, copied, pipeline, captured)


@pytest.mark.parametrize("fault", [*KEEPING, *SPOILING])
@pytest.mark.parametrize("in_place", [True, False], ids=["copied", "renamed"])
def test_after_every_fault_of_the_map_a_good_one_is_taken_up(
    rig: Rig, fault: str, in_place: bool, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    assert rig.status()["status"] == "LOCALIZED"
    assert rig.pipeline.map_problem == ""
    do, problem = (KEEPING | SPOILING)[fault]
    with do(rig.path) or nullcontext():
        for _ in range(3):
            status = rig.status()
            if fault in KEEPING:
                assert status["status"] == "LOCALIZED"
            else:
                assert (status["status"], status["reason"]) == ("FAILED", "BAD_MAP")
            assert problem in rig.pipeline.map_problem
    said = [record.message for record in caplog.records if record.levelname == "ERROR"]
    assert len(said) == len(set(said)) == (1 if fault in KEEPING else 2)  # and why frames fail
    assert problem in said[0]
    assert "\n" not in "".join(said)

    caplog.clear()
    if rig.path.is_dir():
        rig.path.rmdir()
    if in_place and rig.path.exists():
        copy(rig.good, rig.path)
    else:
        rig.good.rename(rig.path)
    assert rig.status()["status"] == "LOCALIZED"
    assert rig.pipeline.map_problem == ""
    assert len(rig.pipeline.reader) == 30
    assert rig.status()["status"] == "LOCALIZED"
    assert [r.message for r in caplog.records if "the map is now" in r.message] == [
        f"the map is now of generation {rig.pipeline.reader.generation}"
    ]


def test_a_map_that_is_copied_in_place_bit_by_bit_is_said_once_and_taken_up(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    octets = rig.good.read_bytes()
    rig.status()
    step = len(octets) // 6
    with rig.path.open("wb") as file:
        for start in range(0, len(octets), step):
            file.write(octets[start : start + step])
            file.flush()
            if start + step < len(octets):
                assert rig.status()["reason"] == "BAD_MAP"
    assert rig.status()["status"] == "LOCALIZED"
    said = [record.message for record in caplog.records if record.levelname == "ERROR"]
    assert len(said) == len(set(said)) == 2
    assert len(rig.pipeline.reader) == 30


def test_a_daemon_survives_one_fault_of_its_map_after_the_other(
    demo: Demo, good: Path, tmp_path: Path
) -> None:
    path = tmp_path / "m.tpmap"
    shutil.copyfile(demo.map, path)
    config = write_config(tmp_path, path, demo.recording, more="rate = 8.0\nloop = true")
    faults = [do for name, (do, _) in (KEEPING | SPOILING).items() if name != "without rights"]
    with daemon(config) as process:
        lines = process.stderr
        assert lines is not None

        def wait_for(text: str) -> None:
            assert any(text in line for line in lines)

        for number, do in enumerate(faults):
            do(path)
            wait_for("going on with the map as it was")
            if path.is_dir():
                path.rmdir()
            if path.exists():
                copy(good, path)
            else:
                shutil.copyfile(good, tmp_path / f"{number}.tpmap").rename(path)
            wait_for("the map is now of generation")
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
    with (tmp_path / "log.mcap").open("rb") as stream:
        messages = make_reader(stream).iter_messages(["trigpoint/test/status"])
        outcomes = [json.loads(m.data).get("reason") or "LOCALIZED" for _, _, m in messages]
    assert {"LOCALIZED", "BAD_MAP"} <= set(outcomes)
