"""Which of many images to take, by their similarity to a query and to one another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]

PREFERENCE = 0.1  # cosine that images of a preferred session are ahead by
POOL = 4  # times as many as are asked for are looked at where they are to be diverse


def find_largest(values: Array32, k: int) -> NDArray[np.intp]:
    """Return where the k largest lie, largest first, equal ones in order."""
    k = min(k, len(values))
    if k < 1:
        return np.empty(0, np.intp)
    candidates = np.flatnonzero(values >= np.partition(values, -k)[-k])
    return candidates[np.argsort(-values[candidates], kind="stable")[:k]]


def choose_diverse(
    similarities: Array32, alike: Array32, k: int, diversity: float
) -> NDArray[np.intp]:
    """Choose images that are like the query, yet unlike one another.

    Maximal marginal relevance (Carbonell and Goldstein, SIGIR 1998), one after the other.

    Parameters
    ----------
    similarities : (M,) float32
        To the query, cosines.
    alike : (M, M) float32
        Of the images to one another.
    k : int
        How many, at the most.
    diversity : float
        What share of an image's similarity to the one most like it among those already chosen is
        taken off its similarity to the query.

    Returns
    -------
    chosen : (min(k, M),) int
        Best first.
    """
    scores, nearest = similarities.copy(), np.zeros_like(similarities)
    chosen = np.empty(min(k, len(scores)), np.intp)
    for i in range(len(chosen)):
        chosen[i] = best = int(np.argmax(scores))
        np.maximum(nearest, alike[best], out=nearest)
        scores = similarities - diversity * nearest
        scores[chosen[: i + 1]] = -np.inf
    return chosen
