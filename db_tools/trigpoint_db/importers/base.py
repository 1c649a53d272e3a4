"""What every importer gives: images with cameras and poses, in our conventions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from trigpoint.camera import Camera
from trigpoint.rigid import Rigid3
from trigpoint_db.poses import Query


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of the survey: its camera and where it stood."""

    name: str
    camera: Camera
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class Dataset:
    """Images to map and images to localize; names are relative to the folder `images`.

    Cameras have the pixel convention of `trigpoint.camera`; poses are cam_from_world with x to the
    right, y down, z ahead, in the unit of the data set. `truth` has the poses of those queries that
    have a public one.
    """

    images: Path
    mapped: list[PosedImage]
    queries: list[Query] = field(default_factory=list)
    truth: dict[str, Rigid3] = field(default_factory=dict)
