"""Data sets that tests of importers and of commands share, rendered once a session."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.unit.layouts import View, write_aachen, write_seven_scenes


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
