"""What tests of the commands share, and data sets, rendered once a session."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from tests.unit.layouts import View, write_aachen, write_seven_scenes
from trigpoint_db.cli import main


class Run:
    """Runs the command within this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch = monkeypatch
        self._capsys = capsys

    def __call__(self, *arguments: object) -> tuple[int, str, str]:
        self._monkeypatch.setattr(sys, "argv", ["trigpoint-db", *map(str, arguments)])
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            main()
        code = caught.value.code
        out, err = self._capsys.readouterr()
        if isinstance(code, str):  # what sys.exit(message) prints once the interpreter ends
            return 1, out, code
        return int(code or 0), out, err


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    return Run(monkeypatch, capsys)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, View]]:
    root = tmp_path_factory.mktemp("7scenes") / "redkitchen"
    return root, write_seven_scenes(root)


@pytest.fixture(scope="session")
def town(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, View]]:
    root = tmp_path_factory.mktemp("aachen")
    return root, write_aachen(root)


@pytest.fixture
def town_copy(town: tuple[Path, dict[str, View]], tmp_path: Path) -> Path:
    """The same, to change."""
    return Path(shutil.copytree(town[0], tmp_path / "town"))
