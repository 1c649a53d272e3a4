"""LMDB's pages, checked before LMDB walks through them.

LMDB trusts its file: a wrong number in a tree page, or a file cut short, crashes the process. So
before each look-up the pages on its way are read and checked here, each once in a snapshot. What
is reachable then lies inside its page and inside the file; the contents have their own checksums.

The layout is that of LMDB 0.9's `mdb.c` (data format 1) on 64-bit little-endian machines.
"""

from __future__ import annotations

import os
import struct
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import DatabaseError

HEADER_BYTES = 16
_HEADER = struct.Struct("<QHHHH")  # number, unused, kind, end of pointers, begin of nodes
_BRANCH, _LEAF, _META = 1, 2, 8
# Magic, version, address, size of the mapping; twice flags, depth, counts, root; last page, commit
_META_BODY = struct.Struct("<IIQQ IHH5Q IHH5Q QQ")
_MAGIC, _VERSION = 0xBEEFC0DE, 1
_FIXED_ADDRESS = 1
_NODE_BYTES = 8  # size or child in three u16 (the third: flags), size of the key
_LARGE, _DUPLICATES = 1, 4  # flags: the value has pages of its own; several values
_NO_PAGE = 2**64 - 1


@dataclass(frozen=True)
class Meta:
    """The root of one commit."""

    page_bytes: int
    num_pages: int
    depth: int
    root: int
    commit: int


def read_meta(fd: int, slot: int) -> Meta:
    """Read one of the two roots, which commits write in turn."""
    first = os.pread(fd, HEADER_BYTES + _META_BODY.size, 0)
    page_bytes = _parse_meta(first).page_bytes
    meta = _parse_meta(os.pread(fd, HEADER_BYTES + _META_BODY.size, slot * page_bytes))
    # The file's size after the root: a writer makes the file longer before it commits.
    size, wanted = os.fstat(fd).st_size, meta.num_pages * page_bytes
    if size < wanted or meta.page_bytes != page_bytes:
        raise DatabaseError(f"is cut short: {size} of {wanted} bytes are there; copy it again")
    return meta


def _parse_meta(page: bytes) -> Meta:
    if len(page) < HEADER_BYTES + _META_BODY.size:
        raise DatabaseError("is not a Trigpoint map")
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
        raise DatabaseError("is not a Trigpoint map")
    return Meta(page_bytes, last_page + 1, depth, root, commit)


class Tree:
    """The B-tree of one commit."""

    def __init__(self, fd: int, meta: Meta) -> None:
        self._fd = fd
        self._meta = meta
        self._checked: dict[int, tuple[list[bytes], list[int]]] = {}

    def check(self, key: bytes) -> None:
        """Raise DatabaseError unless LMDB can look up the key safely."""
        meta = self._meta
        if os.fstat(self._fd).st_size < meta.num_pages * meta.page_bytes:
            raise DatabaseError("was cut short while open; replace a map by renaming, not in place")
        page = meta.root
        if page == _NO_PAGE:
            return
        if not (1 <= meta.depth <= 32 and 2 <= page < meta.num_pages):
            raise DatabaseError("the root of the tree is damaged")
        for level in reversed(range(meta.depth)):
            if page not in self._checked:
                self._checked[page] = self._check_page(page, is_leaf=level == 0)
            separators, children = self._checked[page]
            if level > 0:
                page = children[bisect_right(separators, key)]

    def _check_page(self, number: int, *, is_leaf: bool) -> tuple[list[bytes], list[int]]:
        """Check a page; of a branch return the keys between its children, and these."""
        size, num_pages = self._meta.page_bytes, self._meta.num_pages
        damaged = DatabaseError(f"page {number} of the tree is damaged")
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
        low, high, flags, key_bytes = _gather(octets, at, "<u2").astype(np.int64).T
        key_end = at + _NODE_BYTES + key_bytes
        if is_leaf:
            length, large = low | high << 16, flags & _LARGE == 1
            if (flags & _DUPLICATES).any() or (key_end + np.where(large, 8, length)).max() > size:
                raise damaged
            first = _gather(octets, key_end[large], "<u8")[:, 0]
            last = first + ((length[large] + HEADER_BYTES - 1) // size).astype(np.uint64)
            children = np.concatenate([first, last])
        else:
            children = (low | high << 16 | flags << 32).astype(np.uint64)
        if key_end.max() > size or ((children < 2) | (children >= num_pages)).any():
            raise damaged
        ends = zip((at + _NODE_BYTES).tolist(), key_end.tolist(), strict=True)
        keys = [page[begin:end] for begin, end in ends][0 if is_leaf else 1 :]
        if any(key >= following for key, following in pairwise(keys)):
            raise damaged
        return ([], []) if is_leaf else (keys, children.tolist())


def _gather(octets: NDArray[np.uint8], at: NDArray[np.int64], kind: str) -> NDArray[np.generic]:
    """Read 8 bytes from each place: (n, 8 / item size)."""
    return octets[at[:, None] + np.arange(8)].view(kind)
