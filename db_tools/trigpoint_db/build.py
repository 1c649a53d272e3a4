"""Make a map from images with known poses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from trigpoint.camera import Camera
from trigpoint.database.codec import Profile
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import COMMIT_EVERY, new_map
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.frame import Frame, Session
from trigpoint.images import read_gray
from trigpoint.models.features import FeatureModel
from trigpoint_db.importers.colmap import PosedImage


def select_images(images: Sequence[PosedImage], names: Sequence[str]) -> list[PosedImage]:
    """Keep the images named; a name that the model does not know is an error."""
    by_name = {image.name: image for image in images}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise ConfigError(
            f"{len(unknown)} of {len(names)} listed images are not in the COLMAP model, "
            f"such as {unknown[0]!r}"
        )
    return [by_name[name] for name in names]


def select_new(
    images: Sequence[PosedImage], path: Path, *, skip_existing: bool
) -> list[PosedImage]:
    """Keep the images that a map does not have; unless they may be skipped, others are an error."""
    with MapReader.open(path) as reader:
        names = set(reader.names())
    new = [image for image in images if image.name not in names]
    if len(new) < len(images) and not skip_existing:
        known = next(image.name for image in images if image.name in names)
        raise ConfigError(
            f"{path} holds {len(images) - len(new)} of {len(images)} images already, such as "
            f"{known!r}; leave them out with --skip-existing"
        )
    return new


def check_files(names: Iterable[str], folder: Path) -> None:
    """Refuse before any work is done where an image is missing."""
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise ConfigError(f"{len(missing)} images are missing in {folder}, such as {missing[0]!r}")


def read_frame(path: Path, camera: Camera, name: str) -> Frame:
    """Read an image file that a camera has taken."""
    try:
        return Frame(read_gray(path), camera, name=name)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def build_map(
    path: Path,
    images: Iterable[PosedImage],
    folder: Path,
    model: FeatureModel,
    *,
    max_keypoints: int = 1024,
    session: Session | None = None,
    profile: Profile = Profile.STANDARD,
) -> int:
    """Write a new map; it appears under its name when it is complete. Returns the image count."""
    with new_map(path, model.identity, profile) as writer:
        for image in images:
            _add(writer, image, folder, model, max_keypoints, session)
            if len(writer) % COMMIT_EVERY == 0:
                writer.commit()
        return len(writer)


def append_map(
    path: Path,
    images: Iterable[PosedImage],
    folder: Path,
    model: FeatureModel,
    *,
    max_keypoints: int = 1024,
    session: Session | None = None,
) -> int:
    """Add images to a map, each of which is there for good once it is added. Returns how many."""
    with MapWriter.open(path, model.identity) as writer:
        before = len(writer)
        for image in images:
            _add(writer, image, folder, model, max_keypoints, session)
            writer.commit()
        return len(writer) - before


def _add(
    writer: MapWriter,
    image: PosedImage,
    folder: Path,
    model: FeatureModel,
    max_keypoints: int,
    session: Session | None,
) -> None:
    frame = read_frame(folder / image.name, image.camera, image.name)
    features = model.extract(frame.image, max_keypoints)
    writer.add(image.name, image.camera, image.cam_from_world, features, session)
