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
from trigpoint.database.pages import DamageError
from trigpoint.database.ranking import POOL, PREFERENCE, choose_diverse, find_largest
from trigpoint.database.snapshot import OVERWRITTEN, LockFileError, Snapshot, reporting
from trigpoint.errors import DatabaseError
from trigpoint.frame import (
    Anchor,
    LocalFeatures,
    ModelIdentity,
    PoseNoise,
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
        self._snapshot: Snapshot | None = snapshot
        self._metadata, self._file = snapshot.metadata, snapshot.file
        self._is_closed = False

    @classmethod
    def open(cls, path: Path, model: ModelIdentity | None = None) -> Self:
        """Open a map; with a model, refuse a map that was made with another one."""
        with reporting(path):
            return cls(path, Snapshot(path, model))

    @property
    def _current(self) -> Snapshot:
        if self._snapshot is None:
            why = "this reader is closed" if self._is_closed else OVERWRITTEN
            raise DatabaseError(f"{self._path}: {why}")
        return self._snapshot

    @contextmanager
    def _reading(self) -> Iterator[Snapshot]:
        snapshot = self._current
        with reporting(self._path):
            try:
                yield snapshot
            finally:
                snapshot.require_kept()

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
        with self._reading() as snapshot:
            return [table[i] for b in _blocks(snapshot) for i in b.sessions.tolist()]

    def view(self, index: int) -> tuple[Camera, Rigid3]:
        """Return the camera of an image and its pose, cam_from_world."""
        with self._reading() as snapshot:
            image = _image(snapshot, index)
            return image.camera, image.cam_from_world

    def anchor(self, index: int) -> Anchor:
        """Return an image with its features."""
        with self._reading() as snapshot:
            image = _image(snapshot, index)
            keypoints, descriptors = schema.decode_features(
                image, snapshot.get(schema.features_key(index)), self.model.descriptor_dim
            )
        return Anchor(image.name, image.camera, image.cam_from_world, keypoints, descriptors)

    def record(self, index: int) -> schema.Record:
        """Return an image as it lies in the map, for another map."""
        with self._reading() as snapshot:
            _require_index(snapshot, index)
            block, place = divmod(index, schema.BLOCK_ROWS)
            row = _block(snapshot, block).row(place)
            image = bytes(snapshot.get(schema.image_key(index)))
            return schema.Record(
                schema.decode_name(memoryview(image)),
                image,
                bytes(snapshot.get(schema.features_key(index))),
                row,
                (None, *self.sessions)[row.session],
            )

    def features(self, index: int) -> LocalFeatures:
        """Return an image's features as if it were a query; its scores are not in the map."""
        anchor = self.anchor(index)
        with self._reading() as snapshot:
            (described,) = _descriptors(snapshot, np.array([index]))
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
    ) -> tuple[NDArray[np.intp], Array32]:
        """Find the images that look most alike, by comparing with all.

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
        similarities = np.empty(len(self), np.float32)
        scores = similarities if bonus is None else np.empty_like(similarities)
        with self._reading() as snapshot:
            for i, block in enumerate(_blocks(snapshot)):
                part = slice(schema.BLOCK_ROWS * i, schema.BLOCK_ROWS * (i + 1))
                rows = block.numbers.astype(np.float32)
                np.multiply(rows @ global_descriptor, block.scales, out=similarities[part])
                if bonus is not None:
                    np.add(similarities[part], bonus[block.sessions], out=scores[part])
            best = find_largest(scores, k if diversity == 0 else POOL * k)
            best = best[scores[best] > -np.inf]
            if diversity > 0:
                alike = _descriptors(snapshot, best)
                best = best[choose_diverse(scores[best], alike @ alike.T, k, diversity)]
        return best, similarities[best]

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
            if self._snapshot is not None and self._snapshot.is_newest(self._path):
                return False
            new = self._open_newest()
        if self._snapshot is not None and new.state == self._snapshot.state:
            new.close()
        else:
            self._let_go()
            self._snapshot, self._metadata, self._file = new, new.metadata, new.file
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
        num_blocks = -(-len(self) // schema.BLOCK_ROWS)
        with self._reading() as snapshot:
            snapshot.forget_checks()
            for index in range(len(self)):
                with _collecting(problems):
                    name = _image(snapshot, index).name
                    snapshot.get(schema.features_key(index))
                    if schema.decode_index(snapshot.get(schema.name_key(name))) != index:
                        problems.append(f"the name {name!r} does not lead to image {index}")
            for block in range(num_blocks):
                with _collecting(problems):
                    _block(snapshot, block)
            found, wanted = snapshot.count_entries(), 1 + 3 * len(self) + num_blocks
            if found != wanted:
                problems.append(f"there are {found} entries where {wanted} belong")
        return list(dict.fromkeys(problems))  # a page is met more than once

    def close(self) -> None:
        """Close the map."""
        self._let_go()
        self._is_closed = True

    def _let_go(self) -> None:
        if self._snapshot is not None:
            self._snapshot.close()
        self._snapshot = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def _collecting(problems: list[str]) -> Iterator[None]:
    try:
        yield
    except DamageError as error:
        problems.append(str(error))


def _require_index(snapshot: Snapshot, index: int) -> None:
    if not 0 <= index < snapshot.metadata.num_images:
        raise DatabaseError(f"no image {index} among {snapshot.metadata.num_images}")


def _image(snapshot: Snapshot, index: int) -> schema.Image:
    _require_index(snapshot, index)
    return schema.decode_image(snapshot.get(schema.image_key(index)))


def _blocks(snapshot: Snapshot) -> Iterator[schema.Block]:
    return (
        _block(snapshot, i) for i in range(-(-snapshot.metadata.num_images // schema.BLOCK_ROWS))
    )


def _block(snapshot: Snapshot, number: int) -> schema.Block:
    metadata = snapshot.metadata
    payload = snapshot.get(schema.block_key(number))
    block = schema.decode_block(payload, metadata.model.global_dim)
    wanted = min(metadata.num_images - number * schema.BLOCK_ROWS, schema.BLOCK_ROWS)
    if len(block.numbers) != wanted:
        raise DamageError(f"retrieval block {number} has {len(block.numbers)} rows, not {wanted}")
    if block.sessions.max() > len(metadata.sessions):
        raise DamageError(f"retrieval block {number} has images of an unknown session")
    return block


def _bonus(
    sessions: tuple[Session, ...], prefer: Collection[str], exclude: Collection[str]
) -> Array32 | None:
    """Return what each session, from none on, adds to a similarity; None if that is nothing."""
    bonus = [0.0] + [
        -np.inf if session.name in exclude else PREFERENCE * (session.name in prefer)
        for session in sessions
    ]
    return np.array(bonus, np.float32) if any(bonus) else None


def _descriptors(snapshot: Snapshot, indices: NDArray[np.intp]) -> Array32:
    """Return the global descriptors of some images (K, G)."""
    descriptors = np.empty((len(indices), snapshot.metadata.model.global_dim), np.float32)
    block_of = indices // schema.BLOCK_ROWS
    for block in np.unique(block_of):
        rows = _block(snapshot, int(block))
        here = block_of == block
        inside = indices[here] % schema.BLOCK_ROWS
        descriptors[here] = rows.numbers[inside] * rows.scales[inside, None]
    return descriptors
