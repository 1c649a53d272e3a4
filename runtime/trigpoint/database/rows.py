"""Retrieval rows as they lie on disk, in blocks and in lists of the index; see `schema`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]


def quantize_row(row: Array32) -> tuple[np.float32, NDArray[np.int8]]:
    """Return the scale and the int8 numbers (G,) of a global descriptor; zero stays zero."""
    peak = max(float(np.abs(row).max()), 1e-30)
    numbers = np.rint(row / np.float32(peak) * 127).astype(np.int8)
    norm = float(np.linalg.norm(numbers.astype(np.float32)))
    return np.float32(1 / max(norm, 1.0)), numbers


class Row(NamedTuple):
    """What retrieval knows of an image: its global descriptor is scale * numbers."""

    scale: np.float32
    center: Array32  # (3,): where its camera was
    session: int
    numbers: NDArray[np.int8]  # (G,)


class Block(NamedTuple):
    """Retrieval rows of several images."""

    scales: Array32  # (n,)
    centers: Array32  # (n, 3)
    sessions: NDArray[np.uint16]  # (n,)
    numbers: NDArray[np.int8]  # (n, G)

    @classmethod
    def concatenate(cls, blocks: Sequence[Block]) -> Block:
        """Put blocks, at least one, together."""
        return cls._make(map(np.concatenate, zip(*blocks, strict=True)))

    @property
    def descriptors(self) -> Array32:
        """The global descriptors (n, G)."""
        return self.numbers * self.scales[:, None]

    def row(self, place: int) -> Row:
        """Copy one of them."""
        return Row(
            self.scales[place],
            self.centers[place].copy(),
            int(self.sessions[place]),
            self.numbers[place].copy(),
        )

    def choose(self, places: NDArray[np.intp]) -> Block:
        """Return some of them, in this order; all of them without a copy."""
        if len(places) == len(self.scales):
            return self
        return Block._make(values[places] for values in self)

    def encode(self) -> bytes:
        """Write them."""
        return b"".join(values.tobytes() for values in self)


def encode_block(rows: Sequence[Row]) -> bytes:
    """Write retrieval rows."""
    scales, centers, sessions, numbers = zip(*rows, strict=True)
    return Block(
        np.array(scales, "<f4"),
        np.array(centers, "<f4"),
        np.array(sessions, "<u2"),
        np.array(numbers, np.int8),
    ).encode()


def decode_block(payload: memoryview, dim: int) -> Block:
    """View retrieval rows of G = `dim` numbers where they lie."""
    num_rows = len(payload) // (4 + 12 + 2 + dim)
    ends = np.cumsum([0, 4 * num_rows, 12 * num_rows, 2 * num_rows, dim * num_rows]).tolist()
    scales, centers, sessions, numbers = (payload[a:b] for a, b in pairwise(ends))
    return Block(
        np.frombuffer(scales, "<f4"),
        np.frombuffer(centers, "<f4").reshape(-1, 3),
        np.frombuffer(sessions, "<u2"),
        np.frombuffer(numbers, np.int8).reshape(-1, dim),
    )


def encode_list(indices: NDArray[np.intp], rows: Block) -> bytes:
    """Write a list of the index."""
    return indices.astype("<u4").tobytes() + rows.encode()


def decode_list(payload: memoryview, dim: int) -> tuple[NDArray[np.intp], Block]:
    """Read the indices (n,) of a list of the index, and view its rows."""
    num_rows = len(payload) // (4 + 4 + 12 + 2 + dim)
    indices = np.frombuffer(payload[: 4 * num_rows], "<u4").astype(np.intp)
    return indices, decode_block(payload[4 * num_rows :], dim)


def encode_centroids(centroids: Array32) -> bytes:
    """Write the centroids (L, G) of the index."""
    return centroids.astype("<f2").tobytes()


def decode_centroids(payload: memoryview, dim: int) -> Array32:
    """Read the centroids (L, G) of the index."""
    return np.frombuffer(payload, "<f2").reshape(-1, dim).astype(np.float32)
