"""Matching the features of two images: mutual nearest neighbours, or a network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.models.contract import MatcherContract
from trigpoint.models.session import Network, open_network

Array32 = NDArray[np.float32]
Index = NDArray[np.intp]

# With fewer, nothing tells pairs (P, 2) from indices by keypoint (1, N), and there is no pose.
_MIN_KEYPOINTS = 4


@dataclass(frozen=True, eq=False)
class Matchable:
    """What a matcher is told of an image."""

    keypoints: Array32  # (N, 2) px
    descriptors: Array32  # (N, D), L2-normalised
    width: int
    height: int


class Matcher(Protocol):
    """Finds which features of two images show the same point."""

    def match(self, query: Matchable, anchor: Matchable) -> tuple[Index, Array32]:
        """Return matches (P, 2), query index and anchor index, and scores (P,), best first.

        No feature is in two matches. Raises ModelError where a network fails.
        """


class MutualNearestNeighbors:
    """Matches descriptors that are each other's nearest neighbour."""

    def match(self, query: Matchable, anchor: Matchable) -> tuple[Index, Array32]:
        """Match two images; the scores are cosines."""
        return match_mutual(query.descriptors, anchor.descriptors)


def match_mutual(query: Array32, anchor: Array32) -> tuple[Index, Array32]:
    """Match descriptors that are each other's nearest neighbour.

    Parameters
    ----------
    query, anchor : (N, D), (M, D) float32
        L2-normalised.

    Returns
    -------
    matches : (P, 2) int
        Query index, anchor index, most similar first.
    similarities : (P,) float32
        Cosines.
    """
    if len(query) == 0 or len(anchor) == 0:
        return _NOTHING
    similarity = query @ anchor.T
    nearest = similarity.argmax(axis=1)
    best = similarity[np.arange(len(query)), nearest]
    # Against the column's maximum, not its arg-max: that is 20 times dearer in numpy.
    mutual = np.flatnonzero(best >= similarity.max(axis=0)[nearest])
    order = mutual[np.argsort(-best[mutual], kind="stable")]
    return np.stack([order, nearest[order]], axis=1), best[order]


_NOTHING = (np.empty((0, 2), np.intp), np.empty(0, np.float32))


@dataclass(frozen=True, eq=False)
class OnnxMatcher:
    """A network that matches, such as LightGlue."""

    network: Network[MatcherContract]

    @classmethod
    def load(cls, path: Path, descriptor_dim: int, *, num_threads: int = 2) -> OnnxMatcher:
        """Load a network of kind "matcher" for descriptors of `descriptor_dim` numbers."""
        network = open_network(path, MatcherContract, num_threads)
        wanted = network.contract.descriptor_dim
        if wanted != descriptor_dim:
            raise ModelError(
                f"{path} matches descriptors of {wanted} numbers, and the feature network's have "
                f"{descriptor_dim}; use the matcher that was trained with it"
            )
        for name in network.contract.inputs:
            if isinstance(num := network.declared(name)[1], int):
                raise ModelError(
                    f"{path} matches just {num} keypoints; export it with a dynamic number of them"
                )
        return cls(network)

    def match(self, query: Matchable, anchor: Matchable) -> tuple[Index, Array32]:
        """Match two images; the scores are the network's."""
        if min(len(query.keypoints), len(anchor.keypoints)) < _MIN_KEYPOINTS:
            return _NOTHING
        outputs = self.network.run(
            {
                "kpts0": self._points(query),
                "kpts1": self._points(anchor),
                "desc0": query.descriptors[None],
                "desc1": anchor.descriptors[None],
            }
        )
        pairs, scores = _read_pairs(
            outputs["matches"], outputs["scores"].ravel(), len(query.keypoints)
        )
        self._check(pairs, scores, query, anchor)
        kept = scores > self.network.contract.min_score
        return _one_to_one(pairs[kept], scores[kept])

    def _points(self, image: Matchable) -> Array32:
        points = image.keypoints
        if self.network.contract.keypoints == "centered":
            size = np.array([image.width, image.height], np.float32)
            points = (points - size / 2) / (size.max() / 2)
        return points[None]

    def _check(self, pairs: Index, scores: Array32, query: Matchable, anchor: Matchable) -> None:
        name = self.network.contract.name
        if len(pairs) != len(scores):
            raise ModelError(
                f"the network {name!r} gave {len(pairs)} matches and {len(scores)} scores"
            )
        sizes = (len(query.keypoints), len(anchor.keypoints))
        if ((pairs < 0) | (pairs >= sizes)).any():
            raise ModelError(
                f"the network {name!r} gave a match of a keypoint that there is not, "
                f"of {sizes[0]} and {sizes[1]}"
            )


def load_matcher(path: Path | None, descriptor_dim: int, *, num_threads: int = 2) -> Matcher:
    """Load a network that matches, or without one return the mutual nearest neighbours."""
    if path is None:
        return MutualNearestNeighbors()
    return OnnxMatcher.load(path, descriptor_dim, num_threads=num_threads)


def _read_pairs(matches: NDArray[Any], scores: Array32, num: int) -> tuple[Index, Array32]:
    """Read pairs (P, 2) and their scores from what networks give for `num` query keypoints."""
    if matches.shape == (1, num):  # the anchor's keypoint, or -1
        query = np.flatnonzero(matches[0] >= 0)
        pairs = np.stack([query, matches[0, query].astype(np.intp)], axis=1)
        return pairs, scores[query] if len(scores) == num else scores
    pairs = matches.reshape(-1, matches.shape[-1])[:, -2:]
    return pairs.astype(np.intp), scores


def _one_to_one(pairs: Index, scores: Array32) -> tuple[Index, Array32]:
    """Sort matches, best first, and drop those of a keypoint that has a better one."""
    order = np.argsort(-scores, kind="stable")
    pairs, scores = pairs[order], scores[order]
    first = np.zeros((len(pairs), 2), bool)
    for side in range(2):
        first[np.unique(pairs[:, side], return_index=True)[1], side] = True
    kept = first.all(axis=1)
    return pairs[kept], scores[kept].astype(np.float32)
