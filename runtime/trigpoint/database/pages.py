"""LMDB's pages, checked before LMDB walks through them.

LMDB trusts its file: a wrong number in a page of its tree, or a file cut short, can crash the
process. So before each look-up the pages on its way are read and checked here, each once in a
snapshot: what they refer to lies inside the page and inside the file. What the values hold has
checksums of its own.

The layout is that of `mdb.c` of LMDB 0.9 (data format 1) on 64-bit little-endian machines.
"""

from __future__ import annotations

import os
import struct
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import compress, pairwise

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import DatabaseError

NOT_A_MAP = (
    "not a Trigpoint map, or its first pages are damaged; give a file made by `trigpoint-db build`"
)
HEADER_BYTES = 16
_HEADER = struct.Struct("<QHHHH")  # number, unused, kind, end of pointers, begin of nodes
_BRANCH, _LEAF, _VALUE, _META = 1, 2, 4, 8
# Magic, version, address, size of the mapping; twice flags, depth, counts, root; last page, commit
_META_BODY = struct.Struct("<IIQQ IHH5Q IHH5Q QQ")
_COMMIT = struct.Struct("<Q")
_MAGIC, _VERSION = 0xBEEFC0DE, 1
_FIXED_ADDRESS = 1
_NODE_BYTES = 8  # size or child in three u16 (the third: flags), size of the key
_LARGE, _DUPLICATES = 1, 4  # flags: the value has pages of its own; several values
_NO_PAGE = 2**64 - 1


class DamageError(DatabaseError):
    """The file does not hold what was written."""


@dataclass(frozen=True)
class Meta:
    """The root of one commit."""

    page_bytes: int
    num_pages: int
    depth: int
    root: int
    commit: int
    body: bytes = field(repr=False)

    def encode_pages(self) -> bytes:
        """Write the first two pages of a file that has this root only.

        The other one says the same of the commit before, as LMDB writes even and odd ones in turn.
        """
        commits = {commit % 2: commit for commit in (self.commit, self.commit - 1)}
        return b"".join(
            (
                _HEADER.pack(slot, 0, _META, 0, 0)
                + self.body[: -_COMMIT.size]
                + _COMMIT.pack(commits[slot])
            ).ljust(self.page_bytes, b"\0")
            for slot in (0, 1)
        )


def read_meta(fd: int, slot: int) -> Meta:
    """Read one of the two roots, which commits write in turn."""
    first = os.pread(fd, HEADER_BYTES + _META_BODY.size, 0)
    page_bytes = _parse_meta(first).page_bytes
    meta = _parse_meta(os.pread(fd, HEADER_BYTES + _META_BODY.size, slot * page_bytes))
    # The file's size after the root: a writer makes the file longer before it commits.
    size, wanted = os.fstat(fd).st_size, meta.num_pages * page_bytes
    if size < wanted or meta.page_bytes != page_bytes:
        raise DamageError(f"cut short: it should have {wanted} bytes")
    return meta


def _parse_meta(page: bytes) -> Meta:
    if len(page) < HEADER_BYTES + _META_BODY.size:
        raise DatabaseError(NOT_A_MAP)
    kind = _HEADER.unpack_from(page)[2]
    body = _META_BODY.unpack_from(page, HEADER_BYTES)
    magic, version, _, _, page_bytes, free_flags = body[:6]
    _, flags, depth, *_, root, last_page, commit = body[12:]
    if (
        (kind, magic, version) != (_META, _MAGIC, _VERSION)
        or flags != 0
        or free_flags & _FIXED_ADDRESS
        or page_bytes not in (4096, 8192, 16384, 32768)
        or not 1 <= last_page < 2**40
    ):
        raise DatabaseError(NOT_A_MAP)
    return Meta(page_bytes, last_page + 1, depth, root, commit, page[HEADER_BYTES:])


class Tree:
    """The B-tree of one commit."""

    def __init__(self, fd: int, meta: Meta) -> None:
        self._fd = fd
        self._meta = meta
        self._checked: dict[tuple[int, bool], tuple[list[bytes], list[int]]] = {}

    def check(self, key: bytes) -> None:
        """Raise DamageError unless LMDB can look up the key safely."""
        meta = self._meta
        if os.fstat(self._fd).st_size < meta.num_pages * meta.page_bytes:
            raise DamageError("cut short while open (replace maps by renaming, not in place)")
        if meta.root == _NO_PAGE:
            return
        if not (1 <= meta.depth <= 32 and 2 <= meta.root < meta.num_pages):
            raise DamageError("the root of the tree is damaged")
        page = meta.root
        for _ in range(meta.depth - 1):
            separators, children = self._look_at(page, is_leaf=False)
            page = children[bisect_right(separators, key)]
        keys, values = self._look_at(page, is_leaf=True)
        i = bisect_left(keys, key)
        if i < len(keys) and keys[i] == key:
            found, _, kind, _, _ = _HEADER.unpack(
                os.pread(self._fd, HEADER_BYTES, values[i] * meta.page_bytes)
            )
            if (found, kind) != (values[i], _VALUE):
                raise DamageError(f"page {values[i]} is damaged")

    def forget_checks(self) -> None:
        """Check all pages again."""
        self._checked.clear()

    def _look_at(self, page: int, *, is_leaf: bool) -> tuple[list[bytes], list[int]]:
        if (page, is_leaf) not in self._checked:
            self._checked[page, is_leaf] = self._check_page(page, is_leaf=is_leaf)
        return self._checked[page, is_leaf]

    def _check_page(self, number: int, *, is_leaf: bool) -> tuple[list[bytes], list[int]]:
        """Check a page and return its references to others, with their keys.

        Those of a branch are its children and the keys between them; those of a leaf are the first
        pages of large values.
        """
        size, num_pages = self._meta.page_bytes, self._meta.num_pages
        damaged = DamageError(f"page {number} of the tree is damaged")
        page = os.pread(self._fd, size, number * size)
        if len(page) != size:
            raise damaged
        found, _, kind, lower, upper = _HEADER.unpack_from(page)
        count = (lower - HEADER_BYTES) // 2
        if (
            (found, kind) != (number, _LEAF if is_leaf else _BRANCH)
            or count < (1 if is_leaf else 2)
            or not lower <= upper <= size
        ):
            raise damaged
        octets = np.frombuffer(page, np.uint8)
        at = np.frombuffer(page, "<u2", count, HEADER_BYTES).astype(np.int64)
        if at.min() < upper or at.max() > size - _NODE_BYTES:
            raise damaged
        low, high, flags, key_bytes = _gather(octets, at).view("<u2").astype(np.int64).T
        key_end = at + _NODE_BYTES + key_bytes
        refers = np.ones(count, bool)
        if is_leaf:
            length, refers = low | high << 16, flags & _LARGE == 1
            if (flags & _DUPLICATES).any() or (key_end + np.where(refers, 8, length)).max() > size:
                raise damaged
            pages = _gather(octets, key_end[refers]).view("<u8")[:, 0]
            ends = pages + ((length[refers] + HEADER_BYTES - 1) // size).astype(np.uint64)
        else:
            pages = ends = (low | high << 16 | flags << 32).astype(np.uint64)
        if key_end.max() > size or ((pages < 2) | (pages >= num_pages) | (ends >= num_pages)).any():
            raise damaged
        spans = zip((at + _NODE_BYTES).tolist(), key_end.tolist(), strict=True)
        keys = [page[begin:end] for begin, end in spans][0 if is_leaf else 1 :]
        if any(key >= following for key, following in pairwise(keys)):
            raise damaged
        return list(compress(keys, refers)) if is_leaf else keys, pages.tolist()


def _gather(octets: NDArray[np.uint8], at: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Read 8 bytes from each place (n,): (n, 8)."""
    gathered: NDArray[np.uint8] = octets[at[:, None] + np.arange(8)]
    return gathered
