"""The retrieval rows of a snapshot: which of them are like a query."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trigpoint.database import schema
from trigpoint.database.pages import DamageError
from trigpoint.database.ranking import find_largest
from trigpoint.database.rows import Block, decode_block, decode_centroids, decode_list
from trigpoint.database.snapshot import Snapshot
from trigpoint.frame import Prior

Array32 = NDArray[np.float32]
Index = NDArray[np.intp]

NUM_PROBED = 64  # lists of an index that are looked at
MAX_SCANNED = 50_000  # rows around a prior position that are compared without the index


class Candidates(NamedTuple):
    """Images that may be like a query."""

    indices: Index  # (M,)
    similarities: Array32  # (M,): cosines
    scores: Array32  # (M,): these, and what is added to them

    def best(self, num: int) -> Candidates:
        """Return the `num` of the highest scores, highest first, equal ones by index."""
        order = np.argsort(self.indices, kind="stable")
        order = order[find_largest(self.scores[order], num)]
        return Candidates._make(values[order] for values in self)


class Retrieval:
    """Retrieval rows, read where they lie."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        self._metadata = snapshot.metadata

    @property
    def num_blocks(self) -> int:
        """How many blocks the rows are in."""
        return -(-self._metadata.num_images // schema.BLOCK_ROWS)

    def blocks(self) -> Iterator[Block]:
        """Return all rows, block by block."""
        return (self.block(number) for number in range(self.num_blocks))

    def block(self, number: int) -> Block:
        """Return a block of rows."""
        metadata = self._metadata
        payload = self.snapshot.get(schema.block_key(number))
        block = decode_block(payload, metadata.model.global_dim)
        wanted = min(metadata.num_images - number * schema.BLOCK_ROWS, schema.BLOCK_ROWS)
        if len(block.numbers) != wanted:
            raise DamageError(
                f"retrieval block {number} has {len(block.numbers)} rows, not {wanted}"
            )
        if block.sessions.max() > len(metadata.sessions):
            raise DamageError(f"retrieval block {number} has images of an unknown session")
        return block

    def rows(self, indices: Index) -> Iterator[tuple[Index, Block]]:
        """Return rows (K,), whose indices rise, block by block."""
        numbers = indices // schema.BLOCK_ROWS
        for here in np.split(indices, np.flatnonzero(np.diff(numbers)) + 1):
            if len(here):
                number = int(here[0]) // schema.BLOCK_ROWS
                yield here, self.block(number).choose(here - number * schema.BLOCK_ROWS)

    def descriptors(self, indices: Index) -> Array32:
        """Return the global descriptors of some images (K, G)."""
        order = np.argsort(indices, kind="stable")
        parts = [block.descriptors for _, block in self.rows(indices[order])]
        descriptors = np.empty((len(indices), self._metadata.model.global_dim), np.float32)
        if parts:
            descriptors[order] = np.concatenate(parts)
        return descriptors

    def gather(self, indices: Index) -> Block:
        """Put rows (K,), at least one, whose indices rise, together."""
        return Block.concatenate([block for _, block in self.rows(indices)])

    @cached_property
    def centers(self) -> Array32:
        """The camera centers of all images (N, 3)."""
        return np.concatenate([np.empty((0, 3), np.float32), *(b.centers for b in self.blocks())])

    def search(
        self, descriptor: Array32, num: int, bonus: Array32, prior: Prior | None = None
    ) -> Candidates:
        """Find the images most like a query.

        With an index, the rows it does not know are compared, and those of the lists that are next
        to the query; of more lists until there are `num`.

        Parameters
        ----------
        descriptor : (G,) float32
            L2-normalised.
        num : int
            How many, at the most.
        bonus : (S + 1,) float32
            What sessions, from none on, add to a cosine; images of one with -inf are left out.
        prior : Prior, optional
            Images with centers elsewhere are left out.

        Returns
        -------
        candidates : Candidates
            Best first.
        """
        num_images, index = self._metadata.num_images, self._metadata.index
        is_inside = np.ones(num_images, bool) if prior is None else prior.contains(self.centers)
        is_known = np.zeros(num_images, bool)
        if index is not None and (prior is None or is_inside.sum() > MAX_SCANNED):
            is_known[: index.num_rows] = True
            is_known[self._moved] = False
        scanned = self.rows(np.flatnonzero(is_inside & ~is_known))
        found = [_compare(descriptor, bonus, *part) for part in scanned]
        if is_known.any():
            is_wanted, count = is_inside & is_known, sum(len(part.indices) for part in found)
            for i, number in enumerate(self._nearest_lists(descriptor)):
                if i >= NUM_PROBED and count >= num:
                    break
                indices, block = self.indexed(number)
                kept = np.flatnonzero(indices < num_images)
                kept = kept[is_wanted[indices[kept]]]
                found.append(_compare(descriptor, bonus, indices[kept], block.choose(kept)))
                count += len(found[-1].indices)
        if not found:
            nothing = np.empty(0, np.float32)
            return Candidates(np.empty(0, np.intp), nothing, nothing)
        return Candidates._make(map(np.concatenate, zip(*found, strict=True))).best(num)

    def indexed(self, number: int) -> tuple[Index, Block]:
        """Return a list of the index: the rows it knew, and their indices (n,) at that time."""
        payload = self.snapshot.get(schema.list_key(number))
        return decode_list(payload, self._metadata.model.global_dim)

    def check_index(self, index: schema.InvertedFile) -> None:
        """Raise DamageError unless each row that the index knows is in one of its lists."""
        if len(self._centroids) != index.num_lists:
            raise DamageError(f"the index has {len(self._centroids)} centroids")
        lists = [self.indexed(number)[0] for number in range(index.num_lists)]
        if not np.array_equal(np.sort(np.concatenate(lists)), np.arange(index.num_rows)):
            raise DamageError(f"the index does not have {index.num_rows} rows once each")

    def _nearest_lists(self, descriptor: Array32) -> list[int]:
        order: list[int] = np.argsort(-(self._centroids @ descriptor), kind="stable").tolist()
        return order

    @cached_property
    def _moved(self) -> Index:
        """The images whose rows the index does not know, for they have the place of others."""
        index = self._metadata.index
        moved = np.array(index.moved if index else (), np.intp)
        return moved[moved < self._metadata.num_images]

    @cached_property
    def _centroids(self) -> Array32:
        payload = self.snapshot.get(schema.CENTROIDS_KEY)
        return decode_centroids(payload, self._metadata.model.global_dim)


def _compare(descriptor: Array32, bonus: Array32, indices: Index, rows: Block) -> Candidates:
    similarities = (rows.numbers.astype(np.float32) @ descriptor) * rows.scales
    scores = similarities + bonus[rows.sessions]
    kept = scores > -np.inf
    return Candidates(indices[kept], similarities[kept], scores[kept])
