"""VLAD of local descriptors (Jegou et al., CVPR 2010), whitened: what SIFT can do at retrieval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

Array32 = NDArray[np.float32]

NUM_WORDS = 64
NUM_SAMPLES = 40_000
NUM_ITERATIONS = 15
DIM = 256


@dataclass(frozen=True, eq=False)
class Vlad:
    """Visual words (C, D) and a whitening projection (G, C D) about a mean (C D,)."""

    words: Array32
    mean: Array32
    projection: Array32

    @classmethod
    def learn(cls, images: Sequence[Array32]) -> Vlad:
        """Learn from the descriptors (N, D) of many images."""
        rng = np.random.default_rng(0)
        descriptors = np.concatenate(images)
        sample = rng.choice(len(descriptors), min(NUM_SAMPLES, len(descriptors)), replace=False)
        words, _ = kmeans2(descriptors[sample], NUM_WORDS, NUM_ITERATIONS, minit="++", seed=rng)
        words = words.astype(np.float32)
        vectors = np.array([_aggregate(image, words) for image in images if len(image)])
        mean = vectors.mean(axis=0)
        _, deviations, axes = np.linalg.svd(vectors - mean, full_matrices=False)
        kept = min(DIM, int((deviations > 1e-3 * deviations[0]).sum()))
        scale = np.sqrt(len(vectors)) / deviations[:kept, None]
        return cls(words, mean, (axes[:kept] * scale).astype(np.float32))

    def describe(self, descriptors: Array32) -> Array32:
        """Global descriptor (G,), L2-normalised, of an image's local ones (N, D)."""
        projected = self.projection @ (_aggregate(descriptors, self.words) - self.mean)
        return projected / max(float(np.linalg.norm(projected)), 1e-9)


def _aggregate(descriptors: Array32, words: Array32) -> Array32:
    """Sum the residuals by word, each sum normalised, then the whole: (C D,)."""
    nearest = ((words**2).sum(axis=1) - 2 * descriptors @ words.T).argmin(axis=1)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9)
