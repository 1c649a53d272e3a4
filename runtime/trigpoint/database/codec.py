"""How a map keeps descriptors, by its profile; `docs/adr/0014-profiles.md` says what was tried.

`standard` keeps each number in 8 bits, as the matcher wants it. `compact` keeps it in 2: the
descriptor is rotated, so that its numbers spread like those of a normal distribution whatever the
network, and each is rounded to one of four levels. All of decoding is exact: it gives the same
integers on every machine.
"""

from __future__ import annotations

from enum import StrEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray

from trigpoint.frame import quantize_descriptors

Array32 = NDArray[np.float32]

# The best four levels for a normal distribution, -1.51, -0.453, 0.453 and 1.51, are to each other
# as these; what is nearer to the outer two lies beyond the threshold (Max, 1960).
_LEVELS = np.array([-10, -3, 3, 10], np.int8)
_THRESHOLD = 0.9816  # standard deviations
_PER_BYTE = 4


class Profile(StrEnum):
    """What a map spends on an image."""

    STANDARD = "standard"  # 1 byte for each number of a descriptor
    COMPACT = "compact"  # a quarter of one


def descriptor_bytes(dim: int, profile: Profile) -> int:
    """Return how many bytes a descriptor of `dim` numbers takes."""
    return dim if profile == Profile.STANDARD else len(_rotation(dim)) // _PER_BYTE


def encode_descriptors(descriptors: Array32, profile: Profile) -> bytes:
    """Write L2-normalised descriptors (N, D)."""
    if profile == Profile.STANDARD:
        return quantize_descriptors(descriptors).tobytes()
    rotation = _rotation(descriptors.shape[1])
    numbers = descriptors @ rotation[:, : descriptors.shape[1]].T  # standard deviation 1
    codes = np.searchsorted(np.array([-_THRESHOLD, 0, _THRESHOLD]), numbers).astype(np.uint8)
    places = codes.reshape(-1, _PER_BYTE) << np.arange(0, 2 * _PER_BYTE, 2, dtype=np.uint8)
    packed: NDArray[np.uint8] = np.bitwise_or.reduce(places, axis=1)
    return packed.tobytes()


def decode_descriptors(payload: memoryview, dim: int, profile: Profile) -> NDArray[np.int8]:
    """Read descriptors as `quantize_descriptors` makes them: (N, D) with D = `dim`."""
    if profile == Profile.STANDARD:
        # A copy: the mapping is the snapshot's, which ends.
        return np.frombuffer(payload, np.int8).reshape(-1, dim).copy()
    rotation = _rotation(dim)
    levels = np.take(_levels_of_bytes(), np.frombuffer(payload, np.uint8), axis=0)
    levels = levels.reshape(-1, len(rotation))
    # Sums of integers below 2^24: exact in float32. The rotation multiplies lengths by sqrt(P).
    squares = len(rotation) * np.einsum("ij,ij->i", levels, levels)
    numbers = (levels @ rotation)[:, :dim] / np.sqrt(squares)[:, None]
    return quantize_descriptors(numbers)


@cache
def _rotation(dim: int) -> Array32:
    """Return signs (P, P), P the next power of 2: a Hadamard matrix, by Rudin and Shapiro's signs.

    The Hadamard matrix alone would leave what all descriptors have in common in one number; these
    signs, whose products with its rows are all alike small, spread it over all.
    """
    i = np.arange(max(_PER_BYTE, 1 << (dim - 1).bit_length()))
    hadamard = np.bitwise_count(i[:, None] & i) % 2
    signs = np.bitwise_count(i & i >> 1) % 2
    rotation: Array32 = (1.0 - 2.0 * (hadamard ^ signs)).astype(np.float32)
    return rotation


@cache
def _levels_of_bytes() -> Array32:
    """Return the four levels in each byte: (256, 4)."""
    codes = np.arange(256)[:, None] >> np.arange(0, 2 * _PER_BYTE, 2) & 3
    levels: Array32 = _LEVELS[codes].astype(np.float32)
    return levels
