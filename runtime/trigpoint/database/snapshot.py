"""One consistent state of a map file, and the errors that opening and reading it can give."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from weakref import ReferenceType, ref

import lmdb

from trigpoint.database import schema
from trigpoint.database.pages import NOT_A_MAP, DamageError, Meta, Tree, read_meta
from trigpoint.errors import DatabaseError
from trigpoint.frame import ModelIdentity

MAX_MAP_BYTES = 2**37  # of address space, not of disk; arm64 kernels may offer no more than 2**39
OVERWRITTEN = "overwritten while open (replace maps by renaming, not in place)"
_COPY_BYTES = 2**20
_MAX_TRIES = 100_000  # of a few microseconds; closing a large map may take milliseconds
LOCK_BYTES = 16_384  # more than the lock file of LMDB's 126 readers needs

# LMDB wants one environment for a file in a process: readers and a writer share it. The keys are
# process, path, file, and the inode of the lock file, 0 without one. No WeakValueDictionary: its
# callback comes right after LMDB has closed a file, and what Ctrl-C raises in a callback is lost.
_environments: dict[tuple[int, Path, tuple[int, int], int], ReferenceType[lmdb.Environment]] = {}


def share_environment(path: Path, fd: int) -> lmdb.Environment:
    """Return this process's environment of an open file; it closes with its last user."""
    path = path.resolve()  # LMDB names the lock file after the path: one name for all links
    status = os.fstat(fd)
    file = status.st_dev, status.st_ino
    with _folder_held(path.parent):  # against other threads too
        locks = set()
        for key, reference in list(_environments.items()):
            if key[:2] != (os.getpid(), path):
                continue
            if (environment := reference()) is None:
                del _environments[key]
                continue
            if key[2] == file:
                return environment
            locks.add(key[3])
        require_in_place(path, fd)
        if _lock_inode(path) in locks:
            lock_path(path).unlink()  # of the file that was here before; this one needs its own
        environment = _open_environment(path)
        _environments[os.getpid(), path, file, _lock_inode(path)] = ref(environment)
    return environment


def put_in_place(new: Path, path: Path) -> None:
    """Rename a map onto another one, which readers may have open, but no writer other than we."""
    path = path.resolve()
    with reporting(path), _folder_held(path.parent):
        new.rename(path)
        # It counts the readers of the old file, who keep both; the new one needs its own.
        lock_path(path).unlink(missing_ok=True)


def require_in_place(path: Path, fd: int) -> None:
    """Raise DatabaseError where a path is no longer that of an open file."""
    if not os.path.samestat(os.fstat(fd), path.stat()):
        raise DatabaseError("was replaced while it was being opened; try again")


def lock_path(path: Path) -> Path:
    """Name LMDB's lock file of a map."""
    return path.with_name(path.name + "-lock")


def _lock_inode(path: Path) -> int:
    try:
        return lock_path(path).stat().st_ino
    except FileNotFoundError:
        return 0


@contextmanager
def _folder_held(folder: Path) -> Iterator[None]:
    """Keep others from opening or replacing maps in a folder: map and lock file belong together.

    It takes milliseconds; a process that is stopped (SIGSTOP) meanwhile keeps others waiting.
    Not by a lock on either file: closing one would drop LMDB's own locks.
    """
    fd = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def _open_environment(path: Path) -> lmdb.Environment:
    open_ = partial(
        lmdb.open,
        os.fsencode(path),
        map_size=MAX_MAP_BYTES,
        subdir=False,
        mode=0o644,
        lib_version=0,
    )
    try:
        _reserve_lock(path)
        # A reader too opens for writing where it may, so that a writer can join it in this process.
        environment = _when_closed(partial(open_, readonly=not os.access(path, os.W_OK)))
    except (lmdb.Error, OSError) as error:
        code = error.code if isinstance(error, lmdb.Error) else error.errno
        no_room = (errno.EACCES, errno.EROFS, errno.ENOSPC, errno.EDQUOT)
        if code not in no_room or path.stat().st_size == 0:  # empty: about to be written
            raise
        # No lock file can be made here: read without one, and see `Snapshot.require_kept`.
        return open_(readonly=True, lock=False)
    environment.reader_check()  # frees what readers that died still hold
    return environment


def _when_closed(open_: Callable[[], lmdb.Environment]) -> lmdb.Environment:
    """Open a file that another thread may be closing: it is not to be found, and still open."""
    for _ in range(_MAX_TRIES):
        try:
            return open_()
        except lmdb.Error as error:
            if "already open" not in str(error):
                raise
        os.sched_yield()
    return open_()


def _reserve_lock(path: Path) -> None:
    """Give the lock file its space: LMDB writes it through a mapping, fatally on a full disk."""
    fd = os.open(lock_path(path), os.O_RDWR | os.O_CREAT, 0o644)
    try:
        os.posix_fallocate(fd, 0, LOCK_BYTES)
    finally:
        os.close(fd)


class LockFileError(DatabaseError):
    """LMDB's lock file counts the commits of another file, or of what this one held before."""


@contextmanager
def reporting(path: Path) -> Iterator[None]:
    """Name the map, and what to do, in every error: ours, LMDB's, the operating system's."""
    try:
        yield
    except DamageError as error:
        raise DatabaseError(
            f"{path}: {error}; restore it from a copy or rebuild it with `trigpoint-db build`"
        ) from error
    except DatabaseError as error:
        raise DatabaseError(f"{path}: {error}") from error
    except FileNotFoundError as error:
        raise DatabaseError(f"no such map: {path}; `trigpoint-db build` makes one") from error
    except PermissionError as error:
        raise DatabaseError(f"{path}: permission denied; change its owner or its mode") from error
    except OSError as error:
        raise DatabaseError(f"{path}: {error.strerror}") from error
    except lmdb.InvalidError as error:
        raise DatabaseError(f"{path}: {NOT_A_MAP}") from error
    except lmdb.Error as error:
        raise DatabaseError(f"{path}: {error}") from error


class Snapshot:
    """A map as one commit left it, whatever a writer does meanwhile."""

    def __init__(self, path: Path, model: ModelIdentity | None = None) -> None:
        with ExitStack() as stack:
            # The traceback of an error may hold a snapshot, which must not hold the environment.
            stack.callback(vars(self).clear)
            if not stat.S_ISREG(path.stat().st_mode):
                raise DatabaseError("not a regular file; give the path of a map file")
            self._fd = os.open(path, os.O_RDONLY)
            stack.callback(os.close, self._fd)
            status = os.fstat(self._fd)
            self.file = status.st_dev, status.st_ino
            self._changed_ns = status.st_ctime_ns
            for slot in (0, 1):
                read_meta(self._fd, slot)  # before LMDB sees the file
            self._environment = share_environment(path, self._fd)
            self._txn, meta = self._begin()
            stack.callback(self._txn.abort)
            # The file holds a later commit: one is in progress, or another map was copied over it.
            self.is_behind = self._newest_commit() > self._txn.id()
            self._is_kept = self._environment.info()["num_readers"] > 0
            self._meta, self._tree = meta, Tree(self._fd, meta)
            self._checked: set[bytes] = set()
            self._tree.check(schema.METADATA_KEY)
            if self._txn.get(schema.METADATA_KEY) is None:
                raise DatabaseError(NOT_A_MAP)
            self._metadata = bytes(self._read(schema.METADATA_KEY))
            self.metadata = schema.Metadata.decode(self._metadata)
            if model is not None and model != self.metadata.model:
                raise DatabaseError(
                    f"made with {_describe(self.metadata.model)}, not with {_describe(model)}; "
                    "rebuild it with `trigpoint-db build`"
                )
            self._stack = stack.pop_all()

    def _begin(self) -> tuple[lmdb.Transaction[memoryview], Meta]:
        for _ in range(10):
            txn = self._environment.begin(buffers=True)
            meta = read_meta(self._fd, txn.id() % 2)
            if meta.commit == txn.id():
                return txn, meta
            txn.abort()  # a writer has committed twice since
        raise LockFileError(
            "its lock file belongs to a map that was here before and is still in use, or its first "
            "pages are damaged; remove the lock file"
        )

    @property
    def state(self) -> tuple[object, ...]:
        """Differs between snapshots between which the file was written to."""
        return self.file, self._txn.id(), self._changed_ns

    def get(self, key: bytes) -> memoryview:
        """Return a value where it lies; its checksum is compared the first time."""
        changed_ns = os.fstat(self._fd).st_ctime_ns
        if changed_ns != self._changed_ns:  # by a commit, which leaves this snapshot as it was?
            self.forget_checks()
            if self._read(schema.METADATA_KEY) != self._metadata:
                raise DamageError(OVERWRITTEN)
            self._changed_ns = changed_ns
        return self._read(key)

    def _read(self, key: bytes) -> memoryview:
        self._tree.check(key)
        payload = schema.unseal(key, self._txn.get(key), check=key not in self._checked)
        self._checked.add(key)
        return payload

    def forget_checks(self) -> None:
        """Check everything again."""
        self._checked.clear()
        self._tree.forget_checks()

    def count_entries(self) -> int:
        """Count keys, ours and foreign ones."""
        return self._txn.stat()["entries"]

    def copy_to(self, fd: int) -> None:
        """Write this state to an empty file, each page in its place.

        So two states differ in the pages that changes have touched, which LMDB's own copies do not
        promise of one state beside a writer.
        """
        meta = self._meta
        os.pwrite(fd, meta.encode_pages(), 0)
        offset, end = 2 * meta.page_bytes, meta.num_pages * meta.page_bytes
        while offset < end:
            data = os.pread(self._fd, min(_COPY_BYTES, end - offset), offset)
            if not data:
                raise DamageError("cut short while open (replace maps by renaming, not in place)")
            offset += os.pwrite(fd, data, offset)

    def require_kept(self) -> None:
        """Raise DatabaseError if a writer may have reused pages of this snapshot.

        While the lock file counts this reader, it cannot. Without one, pages that a commit left
        over are reused from the second commit after it on.
        """
        if self._is_kept:
            return
        if self._newest_commit() > self._txn.id() + 1:
            raise DatabaseError(
                "has changed twice since this snapshot, and nothing kept that, as no lock file "
                "can be made beside the map; refresh the reader"
            )

    def is_newest(self, path: Path) -> bool:
        """Whether the path still leads to this file, and nothing was written to it since."""
        status = path.stat()
        found = (status.st_dev, status.st_ino), status.st_ctime_ns
        return found == (self.file, self._changed_ns) and self._newest_commit() == self._txn.id()

    def _newest_commit(self) -> int:
        return max(read_meta(self._fd, slot).commit for slot in (0, 1))

    def close(self) -> None:
        """Let the snapshot go; views of it are invalid from here on."""
        self._stack.close()


def _describe(model: ModelIdentity) -> str:
    return (
        f"model {model.name!r} {model.sha256[:12]} "
        f"({model.descriptor_dim} and {model.global_dim} numbers a descriptor)"
    )
