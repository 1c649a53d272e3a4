"""Retrieval rows of as many places as wanted, made from the descriptors of real ones.

A real survey's descriptors, in the basis of all surveys' principal components, get random signs:
one set of signs makes another place of it. All cosines inside a place stay as they are; places
become as different from each other as photographs of different places. Each row moves part of the
way to the one that was taken next, and noise takes it away as far again, so that no two places have
the same cosines inside.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]

EVERY = 5  # one of so many images is a query
MAX_STEP = 0.5  # of the way to the next image


class Places:
    """Makes places of real surveys.

    Parameters
    ----------
    surveys : sequence of (n, G) float32
        Global descriptors of real surveys, in the order in which they were taken.
    """

    def __init__(self, surveys: Sequence[Array32]) -> None:
        joined = np.concatenate(surveys)
        _, _, basis = np.linalg.svd(joined, full_matrices=True)
        self._surveys = [survey @ basis.T for survey in surveys]
        self._noise = [_noise(survey) for survey in self._surveys]

    def make(self, num_rows: int, num_queries: int, seed: int = 0) -> tuple[Array32, Array32]:
        """Make rows (num_rows, G) and queries (num_queries, G) of the same places."""
        rng = np.random.default_rng(seed)
        rows, queries, count = [], [], 0
        while count < num_rows:
            place = rng.integers(len(self._surveys))
            survey = self._surveys[place]
            signs = rng.choice(np.array([-1, 1], np.float32), survey.shape[1])
            moved = _move(survey, self._noise[place], rng)
            is_query = np.arange(len(survey)) % EVERY == EVERY // 2
            rows.append(moved[~is_query] * signs)
            queries.append(survey[is_query] * signs)
            count += len(rows[-1])
        asked = np.concatenate(queries)
        chosen = rng.choice(len(asked), min(num_queries, len(asked)), replace=False)
        return np.concatenate(rows)[:num_rows], asked[chosen]


def _move(survey: Array32, noise: float, rng: np.random.Generator) -> Array32:
    step = rng.uniform(0, MAX_STEP, (len(survey), 1)).astype(np.float32)
    moved = (1 - step) * survey + step * np.roll(survey, -1, axis=0)
    return normalize(moved + noise * rng.standard_normal(survey.shape, np.float32))


def _noise(survey: Array32) -> float:
    """Find the noise with which rows are as far from the next ones as they were."""
    rng = np.random.default_rng(0)
    low, high = 0.0, 0.1
    for _ in range(12):
        middle = (low + high) / 2
        is_closer = np.median(nearest(_move(survey, middle, rng))) > np.median(nearest(survey))
        low, high = (middle, high) if is_closer else (low, middle)
    return low


def nearest(rows: Array32, rank: int = 1) -> Array32:
    """Return each row's cosine with the one that is so many places behind itself: (n,)."""
    ordered: Array32 = np.sort(rows @ rows.T, axis=1)
    return ordered[:, -1 - rank]


def normalize(rows: Array32) -> Array32:
    """Make rows unit vectors."""
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def compare(real: Mapping[str, Array32], places: Places, seed: int = 0) -> list[list[str]]:
    """Tabulate quantiles of cosines, real and made: in a survey, and between two."""
    rows, _ = places.make(20_000, 0, seed)
    levels = (0.1, 0.5, 0.9)

    def tell(name: str, values: Array32) -> list[str]:
        return [name, *(f"{value:.2f}" for value in np.quantile(values, levels))]

    surveys = list(real.values())
    between = np.concatenate([(a @ b.T).ravel() for a, b in itertools.pairwise(surveys)])
    rng = np.random.default_rng(seed)
    a, b = rows[rng.choice(len(rows), 2000)], rows[rng.choice(len(rows), 2000)]
    inside = np.concatenate([nearest(survey) for survey in surveys])
    return [
        tell("nearest, real", inside),
        tell("nearest, made", nearest(rows)),
        tell("between two, real", between),
        tell("between two, made", (a * b).sum(axis=1)),
    ]
