"""Make a map from images with known poses."""

from __future__ import annotations

import contextlib
import glob
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from trigpoint.camera import Camera
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError, DatabaseError
from trigpoint.frame import Frame
from trigpoint.images import read_gray
from trigpoint.models.features import FeatureModel
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.messages import read_image

COMMIT_EVERY = 100  # images; until then they are in memory


def select_images(images: Sequence[PosedImage], names: Sequence[str]) -> list[PosedImage]:
    """Keep the images named; a name that the model does not know is an error."""
    by_name = {image.name: image for image in images}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise ConfigError(
            f"{len(unknown)} of {len(names)} listed images are not among those with a pose, "
            f"such as {unknown[0]!r}"
        )
    return [by_name[name] for name in names]


def check_files(names: Iterable[str], images: Path) -> None:
    """Refuse before any work is done where an image is missing in a folder."""
    if images.is_file():
        return  # a recording
    missing = [name for name in names if not (images / name).is_file()]
    if missing:
        raise ConfigError(f"{len(missing)} images are missing in {images}, such as {missing[0]!r}")


def read_frame(images: Path, name: str, camera: Camera) -> Frame:
    """Read an image that a camera has taken, from a folder or from a recording."""
    try:
        gray = read_image(images, name) if images.is_file() else read_gray(images / name)
        return Frame(gray, camera, name=name)
    except ConfigError as error:
        raise ConfigError(f"{images}: {name}: {error}") from error


def build_map(
    path: Path,
    images: Iterable[PosedImage],
    folder: Path,
    model: FeatureModel,
    *,
    max_keypoints: int = 1024,
) -> int:
    """Write a new map; it appears under its name when it is complete. Returns the image count.

    The images are read from `folder` by `read_frame`.
    """
    refuse_existing(path)
    _remove_leftovers(path)
    # Under a name of its own, so that two builds at once do not meet.
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with MapWriter.create(partial, model.identity) as writer:
            for image in images:
                _add(writer, image, folder, model, max_keypoints)
                if len(writer) % COMMIT_EVERY == 0:
                    writer.commit()
            count = len(writer)
        refuse_existing(path)
        partial.rename(path)
    except DatabaseError as error:
        raise DatabaseError(str(error).replace(str(partial), str(path))) from error
    finally:
        _remove(partial)
    return count


def _remove(partial: Path) -> None:
    for leftover in (partial, partial.with_name(partial.name + "-lock")):
        with contextlib.suppress(OSError):
            leftover.unlink()


def _remove_leftovers(path: Path) -> None:
    """Remove what builds that were killed have left."""
    for partial in path.parent.glob(f"{glob.escape(path.name)}.*.partial"):
        owner = partial.name.removesuffix(".partial").rpartition(".")[2]
        if owner.isdecimal() and not Path("/proc", owner).exists():
            _remove(partial)


def refuse_existing(path: Path) -> None:
    """Keep a map that is there."""
    if path.exists():
        raise ConfigError(f"{path} exists; remove it first, or add to it with --append")


def append_map(
    path: Path,
    images: Iterable[PosedImage],
    folder: Path,
    model: FeatureModel,
    *,
    max_keypoints: int = 1024,
) -> int:
    """Add images to a map, all or none of them. Returns how many."""
    with MapWriter.open(path, model.identity) as writer:
        before = len(writer)
        for image in images:
            _add(writer, image, folder, model, max_keypoints)
        return len(writer) - before


def _add(
    writer: MapWriter, image: PosedImage, folder: Path, model: FeatureModel, max_keypoints: int
) -> None:
    frame = read_frame(folder, image.name, image.camera)
    features = model.extract(frame.image, max_keypoints)
    writer.add(image.name, image.camera, image.cam_from_world, features)
