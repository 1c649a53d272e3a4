"""The formats of data sets by name, and which of them a folder has."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import cv2

from trigpoint.errors import ConfigError
from trigpoint_db.importers import (
    aachen,
    cambridge,
    colmap,
    euroc,
    hloc,
    kapture,
    mcap,
    robotcar,
    seven_scenes,
    transforms,
    tum,
)
from trigpoint_db.importers.base import Dataset


class Importer(Protocol):
    """A module of this package: one format."""

    def detect(self, root: Path, /) -> bool:
        """Say, from names of files alone, whether `root` has this format."""

    @property
    def read(self) -> Callable[..., Dataset]:
        """`read(root, *, images=None, ...)`: its keyword arguments are the options it knows."""


IMPORTERS: dict[str, Importer] = {
    "colmap": colmap,
    "hloc": hloc,
    "7scenes": seven_scenes,
    "cambridge": cambridge,
    "aachen": aachen,
    "robotcar": robotcar,
    "tum": tum,
    "euroc": euroc,
    "transforms": transforms,
    "kapture": kapture,
    "mcap": mcap,
}


def read_dataset(root: Path, name: str | None = None, **options: object) -> Dataset:
    """Read a data set in the format of this name, or in the one that it is found to have.

    Options that are None are not passed on; one that the format does not know is an error.
    """
    if name is None:
        name = find_format(root)
    elif name not in IMPORTERS:
        raise ConfigError(f"there is no format {name!r}; use one of {', '.join(IMPORTERS)}")
    read = IMPORTERS[name].read
    given = {option: value for option, value in options.items() if value is not None}
    for option in given.keys() - inspect.signature(read).parameters.keys():
        raise ConfigError(
            f"the format {name} has no use for --{option.replace('_', '-')}; leave it out"
        )
    try:
        return read(root, **given)
    except (ValueError, OverflowError, cv2.error) as error:  # a number that is none, and the like
        said = " ".join(str(error).split())[:200]
        raise ConfigError(f"{root} is damaged, or not of the format {name}: {said}") from error


def find_format(root: Path) -> str:
    """Name the one format that a folder or file has."""
    if not root.exists():
        raise ConfigError(f"there is no {root}; give the folder or the file of a data set")
    found = [name for name, importer in IMPORTERS.items() if importer.detect(root)]
    if len(found) != 1:
        known = "could be " + " or ".join(found) if found else "has no format that is known"
        raise ConfigError(f"{root} {known}; say --format {', '.join(found or IMPORTERS)}")
    return found[0]
