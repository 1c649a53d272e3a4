"""Retrieval: whether an anchor that shows what the query shows is among the first few."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.models.methods import NUM_KEYPOINTS, Features
from benchmarks.models.surveys import Survey, shrink
from benchmarks.models.vlad import Vlad
from trigpoint.database.ranking import POOL, choose_diverse, find_largest
from trigpoint.images import read_gray
from trigpoint.options import LocalizerOptions
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.poses import read_names

RANKS = (1, 5, 10, 20)
PHOTOGRAPHS = (".jpg", ".png")

CAPTION = """Share of the block splits' queries with an anchor among the first few that sees the
same (an overlap above 0.3 in both directions at a parallax of at most 50 degrees, from the poses
and median depths). Anchors are chosen as the localizer does, with its diversity, or by similarity
alone. "Matching all" ranks them by their number of mutual matches. SIFT's VLAD has 64 words and is
whitened to 256 numbers, learnt from the photographs."""

Similarity = NDArray[np.float32]


def measure(
    features: Features,
    surveys: Sequence[Survey],
    overlapping: dict[str, NDArray[np.bool_]],
    folders: Sequence[Path],
    photographs: Path | None,
) -> dict[str, Any]:
    """For each way to retrieve, and each set, the rank of every query's first good anchor.

    Ranks start at 1; None where no anchor of the map overlaps with the query.
    """
    method = features.method
    vlad = None
    if method.path is None and photographs is not None:
        vlad = learn_vlad(features, photographs)
    found: dict[str, Any] = {}
    for survey, folder in zip(surveys, folders, strict=True):
        if not (folder / "queries_block.txt").exists():
            continue
        queries, anchors = _split(survey, folder)
        good = overlapping[survey.name][np.ix_(queries, anchors)]

        def describe(index: int, survey: Survey = survey) -> NDArray[np.float32]:
            local = features.of(survey, index)
            return vlad.describe(local.descriptors) if vlad else local.global_descriptor

        if vlad is not None or describe(0).size:
            name = f"{method.name}, VLAD" if vlad else method.name
            rows, columns = (np.array([describe(i) for i in which]) for which in (queries, anchors))
            orders = {
                name: _rank_diverse(rows, columns),
                f"{name}, by similarity": _rank(rows @ columns.T),
            }
            for ranked, order in orders.items():
                found.setdefault(ranked, {})[survey.name] = _first_good(order, good)
        if method.ours and not method.variant:
            similarity = _count_matches(features, survey, queries, anchors)
            name = f"{method.name}, matching all"
            found.setdefault(name, {})[survey.name] = _first_good(_rank(similarity), good)
    return found


def _split(survey: Survey, folder: Path) -> tuple[list[int], list[int]]:
    """Return the indices of the block split's queries and anchors."""
    index = {name: i for i, name in enumerate(survey.names)}
    queries = read_names(folder / "queries_block.txt")
    return [index[n] for n in queries], [index[n] for n in read_names(folder / "map_block.txt")]


def _count_matches(
    features: Features, survey: Survey, queries: list[int], anchors: list[int]
) -> Similarity:
    """Numbers of mutual matches (Q, A): the local features themselves, asked exhaustively."""
    return np.array(
        [
            [
                len(features.method.match(features.of(survey, q), features.of(survey, a)))
                for a in anchors
            ]
            for q in queries
        ],
        np.float32,
    )


def _rank(similarity: Similarity) -> NDArray[np.intp]:
    """Sort the anchors by similarity to each query: indices (Q, A), best first."""
    return np.argsort(-similarity, axis=1, kind="stable")


def _rank_diverse(queries: Similarity, anchors: Similarity) -> NDArray[np.intp]:
    """Put those first that the localizer would take of a map, in its order: indices (Q, A)."""
    k, diversity = RANKS[-1], LocalizerOptions().anchor_diversity
    orders = []
    for similarities in queries @ anchors.T:
        pool = find_largest(similarities, POOL * k)
        alike = anchors[pool] @ anchors[pool].T
        taken = pool[choose_diverse(similarities[pool], alike, k, diversity)]
        others = np.setdiff1d(np.arange(len(anchors)), taken)
        orders.append(np.concatenate([taken, others]))
    return np.array(orders)


def _first_good(order: NDArray[np.intp], good: NDArray[np.bool_]) -> list[int | None]:
    """Ranks, from 1, of the first good anchors in the orders of the queries; None without one."""
    ranked = np.take_along_axis(good, order, axis=1)
    return [int(row.argmax()) + 1 if row.any() else None for row in ranked]


def learn_vlad(features: Features, photographs: Path) -> Vlad:
    """Learn words and whitening from photographs, each whole and in two halves."""
    parts = []
    for path in sorted(photographs.iterdir()):
        if path.suffix in PHOTOGRAPHS:
            image = shrink(read_gray(path))
            found = features.extractor.extract(image, NUM_KEYPOINTS)
            parts.append(found.descriptors)
            left = found.keypoints[:, 0] < image.shape[1] / 2
            parts += [found.descriptors[left], found.descriptors[~left]]
    return Vlad.learn(parts)


def tabulate(results: dict[str, dict[str, Any]]) -> str:
    """Lay out the share of queries with a good anchor among the first, and the most possible."""
    by_set: dict[str, dict[str, list[int | None]]] = {}
    for found in results.values():
        for name, sets in found.items():
            for survey, ranks in sets.items():
                by_set.setdefault(survey, {})[name] = ranks
    rows = []
    for survey, methods in by_set.items():
        ranks = next(iter(methods.values()))
        possible = np.mean([rank is not None for rank in ranks])
        rows.append([survey, "most possible", str(len(ranks))] + [f"{possible:.2f}"] * len(RANKS))
        for name, found in methods.items():
            first = np.array([np.inf if rank is None else rank for rank in found])
            rows.append([survey, name, ""] + [f"{np.mean(first <= rank):.2f}" for rank in RANKS])
    header = ["set", "", "queries", *(f"top {rank}" for rank in RANKS)]
    return markdown(header, rows, num_words=2)
