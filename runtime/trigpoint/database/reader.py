"""Reading a map: everything resident in the mapping, nothing loaded beforehand."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from weakref import WeakValueDictionary

import lmdb
import numpy as np
from numpy.typing import NDArray

from trigpoint.database import schema
from trigpoint.database.pages import Tree, read_meta
from trigpoint.errors import DatabaseError
from trigpoint.frame import Anchor, ModelIdentity
from trigpoint.rigid import Rigid3

MAX_MAP_BYTES = 2**37  # of address space, not of disk; arm64 kernels may have 2**39 of it

# LMDB wants one environment for a file in a process: readers and a writer share it.
_environments: WeakValueDictionary[tuple[int, int, int], lmdb.Environment] = WeakValueDictionary()


def share_environment(path: Path, fd: int) -> lmdb.Environment:
    """Return this process's environment of an open file; it closes with its last user."""
    status = os.fstat(fd)
    key = (os.getpid(), status.st_dev, status.st_ino)
    environment = _environments.get(key)
    if environment is None:
        environment = _environments[key] = _open_environment(path)
    return environment


def _open_environment(path: Path) -> lmdb.Environment:
    # A reader too opens for writing where it may, so that a writer can join it in this process.
    try:
        environment = lmdb.open(
            str(path),
            map_size=MAX_MAP_BYTES,
            subdir=False,
            readonly=not os.access(path, os.W_OK),
            mode=0o644,
            lib_version=0,
        )
    except lmdb.Error as error:
        if error.code not in (errno.EACCES, errno.EROFS):
            raise
        # Nobody may make a lock file here: read without one, and see `Snapshot.is_kept`.
        return lmdb.open(
            str(path),
            map_size=MAX_MAP_BYTES,
            subdir=False,
            readonly=True,
            lock=False,
            lib_version=0,
        )
    environment.reader_check()  # frees what readers that died still hold
    return environment


@contextmanager
def reporting(path: Path) -> Iterator[None]:
    """Name the map in every error, also in LMDB's and the operating system's."""
    try:
        yield
    except DatabaseError as error:
        raise DatabaseError(f"{path}: {error}") from error
    except lmdb.InvalidError as error:
        raise DatabaseError(f"{path}: is not a Trigpoint map") from error
    except (lmdb.Error, OSError) as error:
        raise DatabaseError(f"{path}: {error}") from error


@dataclass(eq=False)
class Snapshot:
    """A map as one commit left it, whatever a writer does meanwhile."""

    file: tuple[int, int]  # device and inode
    metadata: schema.Metadata
    _fd: int
    _txn: lmdb.Transaction[memoryview]
    _tree: Tree
    _checked: set[bytes] = field(default_factory=set)
