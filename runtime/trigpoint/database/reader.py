"""Reading a map: records are read where they lie in the mapping."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.database import schema
from trigpoint.database.codec import Profile
from trigpoint.database.pages import DamageError
from trigpoint.database.ranking import POOL, PREFERENCE, choose_diverse
from trigpoint.database.retrieval import Retrieval
from trigpoint.database.snapshot import OVERWRITTEN, LockFileError, Snapshot, reporting
from trigpoint.errors import DatabaseError
from trigpoint.frame import (
    Anchor,
    LocalFeatures,
    ModelIdentity,
    PoseNoise,
    Prior,
    Session,
    restore_descriptors,
)
from trigpoint.rigid import Rigid3

Array32 = NDArray[np.float32]


class MapReader:
    """A map, read on one snapshot.

    A writer at work cannot reuse pages that the snapshot sees: `refresh` now and then. One thread
    at a time may use a reader.
    """

    def __init__(self, path: Path, snapshot: Snapshot) -> None:
        self._path = path
        self._is_closed = False
        self._take(snapshot)

    def _take(self, snapshot: Snapshot) -> None:
        self._retrieval: Retrieval | None = Retrieval(snapshot)
        self._metadata, self._file = snapshot.metadata, snapshot.file

    @classmethod
    def open(cls, path: Path, model: ModelIdentity | None = None) -> Self:
        """Open a map; with a model, refuse a map that was made with another one."""
        with reporting(path):
            return cls(path, Snapshot(path, model))

    @property
    def _rows(self) -> Retrieval:
        if self._retrieval is None:
            why = "this reader is closed" if self._is_closed else OVERWRITTEN
            raise DatabaseError(f"{self._path}: {why}")
        return self._retrieval

    @contextmanager
    def _reading(self) -> Iterator[Snapshot]:
        snapshot = self._rows.snapshot
        with reporting(self._path):
            try:
                yield snapshot
            finally:
                snapshot.require_kept()

    @property
    def path(self) -> Path:
        """The map's file."""
        return self._path

    @property
    def model(self) -> ModelIdentity:
        """Which network made the features."""
        return self._metadata.model

    @property
    def generation(self) -> int:
        """Rises with each commit."""
        return self._metadata.generation

    @property
    def pose_noise(self) -> PoseNoise | None:
        """How well the poses of the map agree; None where that was not measured."""
        return self._metadata.pose_noise

    @property
    def sessions(self) -> tuple[Session, ...]:
        """The surveys that images of the map are of, or were."""
        return self._metadata.sessions

    @property
    def profile(self) -> Profile:
        """What it spends on an image."""
        return self._metadata.profile

    @property
    def has_index(self) -> bool:
        """Whether `search` compares with some of the images only."""
        return self._metadata.index is not None

    def __len__(self) -> int:
        return self._metadata.num_images

    def names(self) -> list[str]:
        """Return the names of all images, by index."""
        with self._reading() as snapshot:
            images = (snapshot.get(schema.image_key(index)) for index in range(len(self)))
            return [schema.decode_name(image) for image in images]

    def sessions_by_index(self) -> list[Session | None]:
        """Return the session of each image, by index."""
        table = (None, *self.sessions)
        with self._reading():
            return [table[i] for b in self._rows.blocks() for i in b.sessions.tolist()]

    def view(self, index: int) -> tuple[Camera, Rigid3]:
        """Return the camera of an image and its pose, cam_from_world."""
        with self._reading() as snapshot:
            image = _image(snapshot, index)
            return image.camera, image.cam_from_world

    def poses(self) -> Rigid3:
        """Return cam_from_world of all images (N,), by index."""
        with self._reading() as snapshot:
            return Rigid3.stack(_image(snapshot, i).cam_from_world for i in range(len(self)))

    def anchor(self, index: int) -> Anchor:
        """Return an image with its features."""
        with self._reading() as snapshot:
            image = _image(snapshot, index)
            payload = snapshot.get(schema.features_key(index))
            keypoints, descriptors = schema.decode_features(
                image, payload, self.model.descriptor_dim, self.profile
            )
        return Anchor(image.name, image.camera, image.cam_from_world, keypoints, descriptors)

    def record(self, index: int) -> schema.Record:
        """Return an image as it lies in the map, for another map."""
        with self._reading() as snapshot:
            _require_index(snapshot, index)
            block, place = divmod(index, schema.BLOCK_ROWS)
            row = self._rows.block(block).row(place)
            image = bytes(snapshot.get(schema.image_key(index)))
            return schema.Record(
                schema.decode_name(memoryview(image)),
                image,
                bytes(snapshot.get(schema.features_key(index))),
                row,
                (None, *self.sessions)[row.session],
                self.profile,
            )

    def features(self, index: int) -> LocalFeatures:
        """Return an image's features as if it were a query; its scores are not in the map."""
        anchor = self.anchor(index)
        with self._reading():
            (described,) = self._rows.descriptors(np.array([index]))
        scores = np.zeros(len(anchor.keypoints), np.float32)
        descriptors = restore_descriptors(anchor.descriptors)
        return LocalFeatures(anchor.keypoints, descriptors, scores, described)

    def search(
        self,
        global_descriptor: Array32,
        k: int,
        diversity: float = 0.0,
        *,
        prefer: Collection[str] = (),
        exclude: Collection[str] = (),
        prior: Prior | None = None,
    ) -> tuple[NDArray[np.intp], Array32]:
        """Find the images that look most alike.

        Without an index by comparing with all; with one most of these are found.

        Where many images show the same view, and look like the query by accident, they would leave
        no place for the one that is right: `choose_diverse` prefers others.

        Parameters
        ----------
        global_descriptor : (G,) float32
            L2-normalised.
        k : int
            How many, at the most.
        diversity : float
            See `choose_diverse`; the choice is among the `POOL` k most similar images.
        prefer, exclude : collection of str
            Names of sessions: images of the former come as if their cosine were larger by
            `PREFERENCE`, those of the latter not at all. Names that the map does not have are of
            no effect.
        prior : Prior, optional
            Images whose cameras were elsewhere do not come.

        Returns
        -------
        indices : (k,) int
            Best first: without diversity and preferences the most similar, equally similar ones by
            index.
        similarities : (k,) float32
            Cosines.
        """
        dim = self.model.global_dim
        if global_descriptor.shape != (dim,) or not np.isfinite(global_descriptor).all():
            raise DatabaseError(
                f"{self._path}: searched for numbers {global_descriptor.shape}; "
                f"its global descriptors are ({dim},), all finite"
            )
        bonus = _bonus(self.sessions, prefer, exclude)
        num = k if diversity == 0 else POOL * k
        with self._reading():
            found = self._rows.search(global_descriptor, num, bonus, prior)
            if diversity > 0:
                alike = self._rows.descriptors(found.indices)
                chosen = choose_diverse(found.scores, alike @ alike.T, k, diversity)
                return found.indices[chosen], found.similarities[chosen]
        return found.indices, found.similarities

    def copy_to(self, fd: int) -> None:
        """Write the snapshot to an empty file, as a map of its own.

        What two snapshots of a file have in common lies in the same places of their copies.
        """
        with self._reading() as snapshot:
            snapshot.copy_to(fd)

    def refresh(self) -> bool:
        """Move to the newest snapshot, also of another file renamed into place; True if it differs.

        Where that one cannot be used, the error is raised and the old one stays.
        """
        if self._is_closed:
            raise DatabaseError(f"{self._path}: this reader is closed")
        before = self._file, self._metadata
        with reporting(self._path):
            if self._retrieval and self._retrieval.snapshot.is_newest(self._path):
                return False
            new = self._open_newest()
        if self._retrieval and new.state == self._retrieval.snapshot.state:
            new.close()
        else:
            self._let_go()
            self._take(new)
        return (self._file, self._metadata) != before

    def _open_newest(self) -> Snapshot:
        newest = self._try_newest()
        if newest is None:
            # Overwritten in place. LMDB forgets what it knew of the file with its last user.
            self._let_go()
            newest = Snapshot(self._path, self._metadata.model)
        return newest

    def _try_newest(self) -> Snapshot | None:
        """Open the newest snapshot, unless the lock file says that it is another one."""
        try:
            newest = Snapshot(self._path, self._metadata.model)
        except LockFileError:
            status = self._path.stat()
            if self._file != (status.st_dev, status.st_ino):
                raise
            return None
        if newest.is_behind:
            newest.close()
            return None
        return newest

    def verify(self) -> list[str]:
        """Check everything, whether checked before or not, and list what is wrong."""
        problems: list[str] = []
        rows = self._rows
        with self._reading() as snapshot:
            snapshot.forget_checks()
            for index in range(len(self)):
                with _collecting(problems):
                    name = _image(snapshot, index).name
                    with _collecting(problems, f" ({name})"):
                        snapshot.get(schema.features_key(index))
                    if schema.decode_index(snapshot.get(schema.name_key(name))) != index:
                        problems.append(f"the name {name!r} does not lead to image {index}")
            for block in range(rows.num_blocks):
                with _collecting(problems):
                    rows.block(block)
            wanted = 1 + 3 * len(self) + rows.num_blocks
            if (inverted := snapshot.metadata.index) is not None:
                wanted += 1 + inverted.num_lists
                with _collecting(problems):
                    rows.check_index(inverted)
            found = snapshot.count_entries()
            if found != wanted:
                problems.append(f"there are {found} entries where {wanted} belong")
        return list(dict.fromkeys(problems))  # a page is met more than once

    def close(self) -> None:
        """Close the map."""
        self._let_go()
        self._is_closed = True

    def _let_go(self) -> None:
        retrieval, self._retrieval = self._retrieval, None  # gone, even if Ctrl-C ends its closing
        if retrieval is not None:
            retrieval.snapshot.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def _collecting(problems: list[str], of: str = "") -> Iterator[None]:
    try:
        yield
    except DamageError as error:
        problems.append(f"{error}{of}")


def _require_index(snapshot: Snapshot, index: int) -> None:
    if not 0 <= index < snapshot.metadata.num_images:
        raise DatabaseError(f"no image {index} among {snapshot.metadata.num_images}")


def _image(snapshot: Snapshot, index: int) -> schema.Image:
    _require_index(snapshot, index)
    return schema.decode_image(snapshot.get(schema.image_key(index)))


def _bonus(
    sessions: tuple[Session, ...], prefer: Collection[str], exclude: Collection[str]
) -> Array32:
    """Return what each session, from none on, adds to a similarity (S + 1,)."""
    bonus = [0.0] + [
        -np.inf if session.name in exclude else PREFERENCE * (session.name in prefer)
        for session in sessions
    ]
    return np.array(bonus, np.float32)
