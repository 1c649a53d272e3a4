"""The global descriptor: VLAD over the dense descriptor map of the same network pass."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ModelError

Array32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Visual words and whitening, learnt off-line from other images.

    Parameters
    ----------
    mean : (D,) float32
        Mean of normalised local descriptors; what remains without it tells images apart better
        and fits 8 bits.
    centers : (C, D) float32
        The visual words.
    pca_mean : (C * D,) float32
        Mean VLAD vector.
    pca : (G, C * D) float32
        Whitening projection.
    """

    mean: Array32
    centers: Array32
    pca_mean: Array32
    pca: Array32

    @classmethod
    def load(cls, path: Path, dim: int) -> Vocabulary:
        """Read the .npz file, for descriptors of `dim` numbers."""
        try:
            with np.load(path, allow_pickle=False) as arrays:
                vocabulary = cls(
                    *(
                        np.ascontiguousarray(arrays[key], dtype=np.float32)
                        for key in ("mean", "centers", "pca_mean", "pca")
                    )
                )
        except FileNotFoundError:
            raise ModelError(f"no such retrieval vocabulary: {path}") from None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ModelError(f"{path} is not a retrieval vocabulary: {error}") from error
        shapes = (vocabulary.mean.shape, vocabulary.pca_mean.shape, vocabulary.pca.shape[1:])
        size = vocabulary.centers.size
        if (
            not len(vocabulary.pca)
            or vocabulary.centers.shape[1:] != (dim,)
            or shapes != ((dim,), (size,), (size,))
        ):
            raise ModelError(
                f"{path} does not fit the network, whose descriptors have {dim} numbers"
            )
        return vocabulary

    @property
    def global_dim(self) -> int:
        """The size G of the global descriptor."""
        return len(self.pca)

    def center(self, descriptors: Array32) -> Array32:
        """Normalise descriptors (N, D), subtract the mean, normalise again."""
        return normalize(normalize(descriptors) - self.mean)

    def describe(self, descriptors: Array32) -> Array32:
        """Global descriptor (G,), L2-normalised, of centred dense descriptors (N, D).

        VLAD (Jegou et al., CVPR 2010) with intra-normalisation (Arandjelovic and Zisserman, CVPR
        2013): residuals to the nearest word, summed and normalised word by word, then whitened.
        """
        distance = descriptors @ self.centers.T - 0.5 * (self.centers**2).sum(axis=1)
        words = np.zeros_like(distance)
        words[np.arange(len(words)), distance.argmax(axis=1)] = 1.0
        residuals = words.T @ descriptors - words.sum(axis=0)[:, None] * self.centers
        vlad = normalize(normalize(residuals).ravel())
        return normalize(self.pca @ (vlad - self.pca_mean))


def normalize(vectors: Array32) -> Array32:
    """Scale vectors (..., D) to unit length; zero stays zero."""
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Array32 = vectors / np.maximum(norms, np.float32(1e-9))
    return unit
