"""Make a map from images with known poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from trigpoint.camera import Camera
from trigpoint.database.codec import Profile
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import COMMIT_EVERY, growing_map, name_map, partial_map
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.frame import Frame, LocalFeatures, Session
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpoint_db.extraction import Crew, EncodedImage, extract_by_workers, extract_features
from trigpoint_db.importers.base import PosedImage


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


def check_files(names: Iterable[str], images: Path) -> None:
    """Refuse before any work is done where an image is missing in a folder."""
    if images.is_file():
        return  # a recording
    missing = [name for name in names if not (images / name).is_file()]
    if missing:
        raise ConfigError(f"{len(missing)} images are missing in {images}, such as {missing[0]!r}")


def read_frame(images: Path, name: str, camera: Camera) -> Frame:
    """Read an image that a camera has taken, from a folder or from a recording."""
    return EncodedImage.read(images, name, camera).decode()


def build_map(
    path: Path,
    images: Iterable[PosedImage],
    folder: Path,
    model: FeatureModel,
    *,
    max_keypoints: int = 1024,
    session: Session | None = None,
    crew: Crew | None = None,
    resume: bool = False,
    profile: Profile | None = None,
    named: bool = True,
) -> int:
    """Write a new map; it appears under its name when it is complete. Returns the image count.

    The images are read from `folder` by `read_frame`. The same images in the same order give the
    same bytes, whoever does the work. With `resume`, what an interrupted build of the same images
    and profile has committed is taken over; an interrupted one leaves the same records then. One
    that is not `named` stays in `partial_map`, for more to be done before `name_map`.
    """
    with growing_map(path, model.identity, profile, resume=resume) as writer:
        remaining = iter(images)
        if len(writer):
            _pass_over(remaining, partial_map(path), session)
        for image, features in _extract(remaining, folder, model, max_keypoints, crew):
            writer.add(image.name, image.camera, image.cam_from_world, features, session)
            if len(writer) % COMMIT_EVERY == 0:
                writer.commit()
        count = len(writer)
    if named:
        name_map(partial_map(path), path)
    return count


def _pass_over(images: Iterator[PosedImage], path: Path, session: Session | None) -> None:
    """Take off the first images, which a map holds already; others in their places are an error."""
    with MapReader.open(path) as reader:
        names, sessions = reader.names(), reader.sessions_by_index()
        for index, name in enumerate(names):
            camera, pose = reader.view(index)
            image = next(images, None)
            if (
                image is None
                or (image.name, session) != (name, sessions[index])
                or not is_taken_so(image, camera, pose)
            ):
                raise ConfigError(
                    f"{path} was begun with other images, poses or sessions: its image {index} is "
                    f"{name!r}; give those again, or remove it to begin anew"
                )


def is_taken_so(image: PosedImage, camera: Camera, cam_from_world: Rigid3) -> bool:
    """Say whether a camera and a pose are those of an image, but for what a map rounds."""
    R, t = image.cam_from_world.R, image.cam_from_world.t
    return (
        image.camera == camera
        and np.allclose(R, cam_from_world.R, rtol=0, atol=1e-9)
        and np.allclose(t, cam_from_world.t, rtol=1e-9, atol=0)
    )


def append_map(
    path: Path,
    images: Iterable[PosedImage],
    folder: Path,
    model: FeatureModel,
    *,
    max_keypoints: int = 1024,
    session: Session | None = None,
    crew: Crew | None = None,
) -> int:
    """Add images to a map, each of which is there for good once it is added. Returns how many."""
    with MapWriter.open(path, model.identity) as writer:
        before = len(writer)
        for image, features in _extract(images, folder, model, max_keypoints, crew):
            writer.add(image.name, image.camera, image.cam_from_world, features, session)
            writer.commit()
        return len(writer) - before


def _extract(
    images: Iterable[PosedImage],
    folder: Path,
    model: FeatureModel,
    max_keypoints: int,
    crew: Crew | None,
) -> Iterator[tuple[PosedImage, LocalFeatures]]:
    """Pair images with their features; few more than are in work are read ahead."""
    waiting: deque[PosedImage] = deque()

    def read() -> Iterator[EncodedImage]:
        for image in images:
            waiting.append(image)
            yield EncodedImage.read(folder, image.name, image.camera)

    if crew is None:
        extracted = extract_features(read(), model, max_keypoints)
    else:
        extracted = extract_by_workers(read(), crew, max_keypoints)
    return ((waiting.popleft(), features) for features in extracted)
