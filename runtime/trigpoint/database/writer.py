"""Making a map, adding images to it and removing them."""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Self

import lmdb
import numpy as np
from lmdb.verify import VerifyError, verify
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.database import schema
from trigpoint.database.admission import require_features, require_name, require_pose
from trigpoint.database.codec import Profile
from trigpoint.database.pages import DamageError
from trigpoint.database.rows import (
    Block,
    Row,
    decode_block,
    encode_block,
    encode_centroids,
    encode_list,
    quantize_row,
)
from trigpoint.database.snapshot import (
    Snapshot,
    lock_path,
    reporting,
    require_in_place,
    share_environment,
)
from trigpoint.errors import DatabaseError
from trigpoint.frame import LocalFeatures, ModelIdentity, PoseNoise, Session
from trigpoint.rigid import Rigid3

MIN_PAGE_BYTES = 4096
PAGES_A_CHANGE = 32  # that one entry, beside its value, may renew in LMDB's trees


class MapWriter:
    """Adds and removes images. As a context it commits at the end; an exception drops the changes.

    There is one writer of a map at a time, beside any number of readers. Changes not yet committed
    are in memory and lost in a crash; committed ones are on disk. A failure to write closes the
    writer. Use it in one thread.
    """

    def __init__(self, path: Path, fd: int, metadata: schema.Metadata) -> None:
        self._path = path
        self._fd = fd
        self._metadata = metadata  # as committed
        self._num_images = metadata.num_images
        self._pose_noise = metadata.pose_noise
        self._has_removed = False  # since the last commit
        self._num_new_pages = 0  # since then, at the most
        self._sessions = list(metadata.sessions)
        self._index = metadata.index
        self._moved = set(metadata.index.moved) if metadata.index else set[int]()
        self._rows: list[Row] = []  # of the last retrieval block, unless it is full
        self._environment: lmdb.Environment | None = _writable_environment(path, fd)
        self._txn: lmdb.Transaction | None = None

    @classmethod
    def create(
        cls,
        path: Path,
        model: ModelIdentity,
        profile: Profile = Profile.STANDARD,
        generation: int = 0,
    ) -> Self:
        """Make an empty map for features of a model, of the generation that goes before."""
        with reporting(path), ExitStack() as undo:
            try:
                fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
            except FileExistsError:
                raise DatabaseError("exists already; remove it, or add to it") from None
            except FileNotFoundError:
                raise DatabaseError("cannot be made: its folder does not exist") from None
            undo.callback(path.unlink)
            undo.callback(lock_path(path).unlink, missing_ok=True)
            undo.callback(let_writers_in, fd)
            keep_writers_out(fd)
            metadata = schema.Metadata(model, generation, profile=profile)
            environment = _writable_environment(path, fd)
            with environment.begin(write=True) as txn:
                _put(txn, schema.METADATA_KEY, metadata.encode())
            writer = cls(path, fd, metadata)
            undo.pop_all()
            return writer

    @classmethod
    def open(cls, path: Path, model: ModelIdentity) -> Self:
        """Open a map to add images whose features come from the same model."""
        with reporting(path), ExitStack() as undo:
            fd = os.open(path, os.O_RDWR)
            undo.callback(let_writers_in, fd)
            keep_writers_out(fd)
            require_in_place(path, fd)
            Snapshot(path, model).close()  # before LMDB writes to the lock file
            environment = _writable_environment(path, fd)
            # A writer killed at the end of its commit leaves all but the next writer at the commit
            # before: without this, the metadata would be those of another tree.
            environment.begin(write=True).abort()
            with closing(Snapshot(path, model)) as snapshot:
                _require_sound(path)
                writer = cls(path, fd, snapshot.metadata)
                block, num_rows = divmod(len(writer), schema.BLOCK_ROWS)
                if num_rows:
                    writer._rows = writer._decode_rows(snapshot.get(schema.block_key(block)))
            undo.pop_all()
            return writer

    def __len__(self) -> int:
        return self._num_images

    @property
    def generation(self) -> int:
        """Rises with each commit."""
        return self._metadata.generation

    @property
    def profile(self) -> Profile:
        """What the map spends on an image."""
        return self._metadata.profile

    def add(
        self,
        name: str,
        camera: Camera,
        cam_from_world: Rigid3,
        features: LocalFeatures,
        session: Session | None = None,
    ) -> int:
        """Add an image and return its index; one that cannot be added leaves no trace."""
        with self._writing() as txn:
            require_name(name)
            require_pose(name, cam_from_world)
            require_features(name, features, camera, self._metadata.model)
            image, arrays = schema.encode_image(
                name, camera, cam_from_world, features, self._metadata.profile
            )
            scale, numbers = quantize_row(features.global_descriptor)
            center = cam_from_world.center.astype(np.float32)
            row = Row(scale, center, schema.NO_SESSION, numbers)
            profile = self._metadata.profile
            return self._append(txn, schema.Record(name, image, arrays, row, session, profile))

    def add_record(self, record: schema.Record, name: str) -> int:
        """Add an image of another map of the same model under a name; return its index.

        Where the profiles differ, its descriptors are written as this map has them.
        """
        with self._writing() as txn:
            require_name(name)
            own, dim = self._metadata.profile, self._metadata.model.descriptor_dim
            record = schema.recode(record, dim, own)
            image = schema.rename_image(record.image, name)
            return self._append(txn, replace(record, name=name, image=image))

    def _append(self, txn: lmdb.Transaction, record: schema.Record) -> int:
        if txn.get(schema.name_key(record.name)) is not None:
            raise DatabaseError(f"holds an image {record.name!r} already")
        index = self._num_images
        row = record.row._replace(session=self._number_of(record.session))
        self._put(txn, schema.name_key(record.name), schema.encode_index(index))
        self._put(txn, schema.image_key(index), record.image)
        self._put(txn, schema.features_key(index), record.features)
        self._rows.append(row)
        self._num_images += 1
        if len(self._rows) == schema.BLOCK_ROWS:
            self._put_last_block(txn)
            self._rows = []
        return index

    def _number_of(self, session: Session | None) -> int:
        if session is None:
            return schema.NO_SESSION
        if session not in self._sessions:
            if len(self._sessions) == schema.MAX_SESSIONS:
                raise DatabaseError(f"holds {schema.MAX_SESSIONS} sessions, the most it can")
            self._sessions.append(session)
        return self._sessions.index(session) + 1

    def remove(self, name: str) -> None:
        """Remove an image; the last one takes its index, so that there is no gap."""
        with self._writing() as txn:
            require_name(name)
            if txn.get(schema.name_key(name)) is None:
                raise DatabaseError(f"holds no image {name!r}")
            index = schema.decode_index(_get(txn, schema.name_key(name)))
            last = self._num_images - 1
            if not self._rows:
                block = _get(txn, schema.block_key(last // schema.BLOCK_ROWS))
                self._rows = self._decode_rows(block)
            row = self._rows.pop()
            if index != last:
                self._move(txn, last, index, row)
            for key in (schema.name_key(name), schema.image_key(last), schema.features_key(last)):
                self._delete(txn, key)
            if not self._rows:
                self._delete(txn, schema.block_key(last // schema.BLOCK_ROWS))
            self._note_moved(index, last)
            self._num_images, self._has_removed = last, True

    def _move(self, txn: lmdb.Transaction, source: int, target: int, row: Row) -> None:
        """Give the image at the end, whose row has been taken off, another one's index."""
        for key_of in (schema.image_key, schema.features_key):
            self._put(txn, key_of(target), bytes(_get(txn, key_of(source))))
        name = schema.decode_name(_get(txn, schema.image_key(source)))
        self._put(txn, schema.name_key(name), schema.encode_index(target))
        block, place = divmod(target, schema.BLOCK_ROWS)
        if block == source // schema.BLOCK_ROWS:
            self._rows[place] = row
            return
        key = schema.block_key(block)
        rows = self._decode_rows(_get(txn, key))
        rows[place] = row
        self._put(txn, key, encode_block(rows))

    def _note_moved(self, *indices: int) -> None:
        """Remember that the index knows other rows of these indices."""
        if self._index is not None:
            self._moved.update(i for i in indices if i < self._index.num_rows)

    def put_index(
        self,
        num_rows: int,
        centroids: NDArray[np.float32],
        lists: Iterable[tuple[NDArray[np.intp], Block]],
    ) -> None:
        """Put an index of the first rows, lists of indices and rows, in the place of the old."""
        with self._writing() as txn:
            for number in range(0 if self._index is None else self._index.num_lists):
                self._delete(txn, schema.list_key(number))
            self._put(txn, schema.CENTROIDS_KEY, encode_centroids(centroids))
            for number, (indices, rows) in enumerate(lists):
                self._put(txn, schema.list_key(number), encode_list(indices, rows))
            self._index, self._moved = schema.InvertedFile(num_rows, len(centroids)), set()

    def set_pose_noise(self, noise: PoseNoise | None) -> None:
        """Say how well the poses of the map agree, None if that is not known."""
        self._pose_noise = noise

    def commit(self) -> None:
        """Put what was added on disk; returns when it is there."""
        metadata = replace(
            self._metadata,
            num_images=self._num_images,
            pose_noise=self._pose_noise,
            sessions=tuple(self._sessions),
            index=self._index and replace(self._index, moved=tuple(sorted(self._moved))),
        )
        if metadata == self._metadata and not self._has_removed:
            return
        with self._writing() as txn:
            if self._rows:
                self._put_last_block(txn)
            metadata = replace(metadata, generation=metadata.generation + 1)
            self._put(txn, schema.METADATA_KEY, metadata.encode())
            self._resize(self._num_new_pages)
            txn.commit()
            self._resize(0)
            self._txn, self._metadata, self._has_removed = None, metadata, False
            self._num_new_pages = 0

    def copy_to(self, path: Path) -> None:
        """Write what was committed to a new file of the same owner and mode, without free pages."""
        with reporting(self._path):
            if self._environment is None:
                raise DatabaseError("this writer is closed")
            status = os.fstat(self._fd)
            fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            try:
                os.fchown(fd, status.st_uid, status.st_gid)
                os.fchmod(fd, stat.S_IMODE(status.st_mode))
                self._environment.copyfd(fd, compact=True)
                os.fsync(fd)
            finally:
                os.close(fd)

    def close(self) -> None:
        """Drop what was not committed and let other writers in."""
        if self._environment is None:
            return
        if self._txn is not None:
            self._txn.abort()
        self._txn = self._environment = None
        let_writers_in(self._fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exception: type[BaseException] | None, *_: object) -> None:
        try:
            if exception is None:
                self.commit()
        finally:
            self.close()

    @contextmanager
    def _writing(self) -> Iterator[lmdb.Transaction]:
        with reporting(self._path):
            if self._environment is None:
                raise DatabaseError("this writer is closed")
            try:
                if self._txn is None:
                    self._txn = self._environment.begin(write=True)
                yield self._txn
            except (lmdb.Error, OSError) as error:
                self.close()
                reason = error.reason if isinstance(error, lmdb.Error) else error.strerror
                raise DatabaseError(
                    f"cannot be written: {reason}; is the disk full? The map is as it was "
                    "at the last commit"
                ) from error

    def _put(self, txn: lmdb.Transaction, key: bytes, payload: bytes) -> None:
        _put(txn, key, payload)
        self._num_new_pages += len(payload) // MIN_PAGE_BYTES + PAGES_A_CHANGE

    def _delete(self, txn: lmdb.Transaction, key: bytes) -> None:
        txn.delete(key)
        self._num_new_pages += PAGES_A_CHANGE

    def _resize(self, num_new_pages: int) -> None:
        """Make the file hold all pages of the last commit, and so many that the next may add.

        LMDB does not write pages that one commit takes and frees again: where these are the last,
        the file would be shorter than it says, which readers take for a file cut short.
        """
        assert self._environment is not None
        num_pages = self._environment.info()["last_pgno"] + 1 + num_new_pages
        os.ftruncate(self._fd, num_pages * self._environment.stat()["psize"])

    def _put_last_block(self, txn: lmdb.Transaction) -> None:
        block = encode_block(self._rows)
        self._put(txn, schema.block_key((self._num_images - 1) // schema.BLOCK_ROWS), block)

    def _decode_rows(self, payload: memoryview) -> list[Row]:
        block = decode_block(payload, self._metadata.model.global_dim)
        return [block.row(place) for place in range(len(block.scales))]


def _put(txn: lmdb.Transaction, key: bytes, payload: bytes) -> None:
    # Without it LMDB leaves a value that shrinks within a commit more pages than `verify` accepts.
    txn.delete(key)
    txn.put(key, schema.seal(key, payload))


def _get(txn: lmdb.Transaction, key: bytes) -> memoryview:
    value = txn.get(key)
    return schema.unseal(key, None if value is None else memoryview(value))


def _writable_environment(path: Path, fd: int) -> lmdb.Environment:
    environment = share_environment(path, fd)
    if environment.flags()["readonly"]:
        raise DatabaseError(
            "cannot be written: no lock file can be made beside it; is the disk full, or the "
            "folder read-only?"
        )
    return environment


def keep_writers_out(fd: int) -> None:
    """Be the only writer of an open map file until `let_writers_in`; another one is an error."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DatabaseError("another writer has it open; wait until it has finished") from None


def let_writers_in(fd: int) -> None:
    """Close a map file, and let others write, also while a process that was forked has it open."""
    fcntl.flock(fd, fcntl.LOCK_UN)
    os.close(fd)


def _require_sound(path: Path) -> None:
    """Check all that LMDB trusts when it writes: a wrong list of free pages would cost images."""
    try:
        problems = verify(path)  # type: ignore[no-untyped-call]
    except VerifyError as error:
        raise DamageError(str(error)) from error
    if problems:
        raise DamageError(problems[0])
