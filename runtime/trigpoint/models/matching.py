"""Matching the features of two images: mutual nearest neighbours, or a network."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from onnxruntime import InferenceSession

from trigpoint.camera import Camera
from trigpoint.errors import ModelError
from trigpoint.frame import Anchor, LocalFeatures, quantize_descriptors, restore_descriptors
from trigpoint.models.contract import MatcherContract
from trigpoint.models.session import Network, open_network, open_session

Array32 = NDArray[np.float32]
Codes = NDArray[np.int8]
Index = NDArray[np.intp]

# Products of integers; made by `python -m training.products`.
_PRODUCTS = Path(__file__).parent / "weights" / "products.onnx"

# With fewer, nothing tells pairs (P, 2) from indices by keypoint (1, N), and there is no pose.
_MIN_KEYPOINTS = 4


@dataclass(frozen=True, eq=False)
class Matchable:
    """What a matcher is told of an image."""

    keypoints: Array32  # (N, 2) px
    descriptors: NDArray[Any]  # (N, D): float32, L2-normalised, or int8 as a map has them
    width: int
    height: int

    @classmethod
    def of(cls, image: LocalFeatures | Anchor, camera: Camera) -> Matchable:
        """Take it of an image's features and its camera."""
        return cls(image.keypoints, image.descriptors, camera.width, camera.height)

    @cached_property
    def normalized(self) -> Array32:
        """The descriptors (N, D), L2-normalised."""
        if self.descriptors.dtype == np.int8:
            return restore_descriptors(self.descriptors)
        return self.descriptors

    @cached_property
    def left(self) -> NDArray[np.uint8]:
        """The descriptors (N, D) as the left factor of their products: of 8 bits, zero at 128."""
        codes = self.descriptors
        if codes.dtype != np.int8:
            codes = quantize_descriptors(codes)
        return codes.view(np.uint8) ^ np.uint8(128)

    @cached_property
    def right(self) -> Codes:
        """The descriptors (D, N) as the right factor: of 7 bits, so that no sum saturates.

        Without VNNI, x86 processors add two products of 8 bits in 16.
        """
        return np.ascontiguousarray(quantize_descriptors(self.normalized, 63).T)


class Matcher(Protocol):
    """Finds which features of two images show the same point."""

    def match(self, query: Matchable, anchor: Matchable) -> tuple[Index, Array32]:
        """Return matches (P, 2), query index and anchor index, and scores (P,), best first.

        No feature is in two matches. Raises ModelError where a network fails.
        """


class MutualNearestNeighbors:
    """Matches descriptors that are each other's nearest neighbour, in integers of 8 and 7 bits.

    The anchor's are compared as they lie in the map, four times as fast as in floats. Integers are
    exact: the matches are the same on every machine.
    """

    def match(self, query: Matchable, anchor: Matchable) -> tuple[Index, Array32]:
        """Match two images; the scores are cosines."""
        if len(query.keypoints) == 0 or len(anchor.keypoints) == 0:
            return _NOTHING
        (products,) = _products().run(None, {"left": anchor.left, "right": query.right})
        matches, best = _mutual(products)
        dim = len(query.right)
        return matches[:, ::-1], best * np.float32(16 / (127 * 63 * dim))


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
    return _mutual(query @ anchor.T)


def _mutual(similarity: NDArray[Any]) -> tuple[Index, NDArray[Any]]:
    nearest = similarity.argmax(axis=1)
    best = similarity[np.arange(len(similarity)), nearest]
    # Against the column's maximum, not its arg-max: that is 20 times dearer in numpy.
    mutual = np.flatnonzero(best >= similarity.max(axis=0)[nearest])
    order = mutual[np.argsort(-best[mutual], kind="stable")]
    # Of rows that are equally near to a column, the first: it is written last.
    owner = np.empty(similarity.shape[1], np.intp)
    owner[nearest[order[::-1]]] = order[::-1]
    order = order[owner[nearest[order]] == order]
    return np.stack([order, nearest[order]], axis=1), best[order]


_NOTHING = (np.empty((0, 2), np.intp), np.empty(0, np.float32))


@cache
def _products() -> InferenceSession:
    return open_session(_PRODUCTS, num_threads=2)


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
                "desc0": query.normalized[None],
                "desc1": anchor.normalized[None],
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
