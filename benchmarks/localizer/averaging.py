"""Center averaging against translation averaging, by noise and by the number of anchors.

The anchors and queries are those of real surveys; their relative poses are the true ones, turned by
Gaussian errors, as in the paper's synthetic experiment. Its figure has one origin for all; here the
world's is where the survey put it, and far away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trigpoint.frame import Reason
from trigpoint.geometry.center_averaging import (
    average_centers,
    average_centers_robust,
    center_directions,
)
from trigpoint.geometry.rotation_averaging import average_rotations
from trigpoint.geometry.translation_averaging import (
    average_translations,
    average_translations_govindu,
)
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3, rotate, rotation_from_vector
from trigpoint.stages import average_poses
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.poses import read_names, read_queries

Array = NDArray[np.float64]

NOISE_DEG = (0.25, 0.5, 1.0, 2.0, 4.0)
NUM_ANCHORS = (5, 10, 20, 50, 100)
WRONG_SHARES = (0.0, 0.2)  # of the relative poses, in the table by the number of anchors
NUM_DRAWS = 5  # of errors for each query there
MIN_ANCHORS = 60  # sets with fewer images have no place in it
FAR_AWAY = 100.0  # times the spread of the anchors


def center_of(rotation: Array, translation: Array | None) -> Array | None:
    """Turn T_q into the center."""
    return None if translation is None else -rotation.T @ translation


def agree_and_average(anchors: Rigid3, relative: Rigid3, _: Array) -> Array | None:
    """Do as the localizer does: drop those that do not agree, and average the others."""
    averaged = average_poses(anchors, relative, LocalizerOptions())
    return None if isinstance(averaged, Reason) else averaged[0].center


AVERAGES: dict[str, Callable[[Rigid3, Rigid3, Array], Array | None]] = {
    "consensus, center, robust": agree_and_average,
    "center, robust": lambda anchors, relative, _: average_centers_robust(
        anchors.center, center_directions(anchors, relative)
    ),
    "center, least squares": lambda anchors, relative, _: average_centers(
        anchors.center, center_directions(anchors, relative)
    ),
    "translation, closed form": lambda anchors, relative, R: center_of(
        R, average_translations(anchors, relative)
    ),
    "translation, Govindu": lambda anchors, relative, R: center_of(
        R, average_translations_govindu(anchors, relative)
    ),
}


def measure(
    anchors: Rigid3,
    query: Rigid3,
    noise_deg: float,
    rng: np.random.Generator,
    wrong_share: float = 0.0,
) -> list[float]:
    """Errors of each average, over the median distance of the five nearest anchors."""
    num = len(anchors)
    exact = anchors @ query.inverse()
    turns = rotation_from_vector(rng.normal(size=(2, num, 3)) * np.deg2rad(noise_deg))
    wrong = rng.random(num) < wrong_share
    turns[1, wrong] = rotation_from_vector(rng.normal(size=(int(wrong.sum()), 3)))
    relative = Rigid3(turns[0] @ exact.R, rotate(turns[1], exact.t)).inverse()
    relative = Rigid3(relative.R, relative.t / np.linalg.norm(relative.t, axis=1, keepdims=True))
    R = average_rotations(relative.R @ anchors.R)
    distance = float(np.median(np.linalg.norm(anchors.center - query.center, axis=1)[:5]))
    centers = [average(anchors, relative, R) for average in AVERAGES.values()]
    return [
        np.inf if c is None else float(np.linalg.norm(c - query.center)) / distance for c in centers
    ]


def nearest(survey: Rigid3, query: Rigid3, num: int) -> Rigid3:
    """Take the images taken nearest to the query, but none from its very place."""
    distances = np.linalg.norm(survey.center - query.center, axis=1)
    order = np.argsort(distances, kind="stable")
    return survey[order[distances[order] > 1e-3 * distances.max()][:num]]


def moved(poses: Rigid3, offset: Array) -> Rigid3:
    """Put the world's origin elsewhere."""
    return Rigid3.from_center(poses.R, poses.center + offset)


def read_set(folder: Path) -> tuple[Rigid3, list[Rigid3]]:
    """Return the poses of a survey and of its queries."""
    poses = {image.name: image.cam_from_world for image in read_model(folder / "sparse")}
    names = read_names(folder / "map.txt")
    queries = [poses[query.name] for query in read_queries(folder / "queries.txt")]
    return Rigid3.stack(poses[name] for name in names), queries


def report(folders: Sequence[Path]) -> str:
    """Make both tables: medians over all queries of all sets, in percent."""
    sets = [read_set(folder) for folder in folders]
    by_noise = []
    for where, factor in (("at the survey's origin", 0.0), ("far away", FAR_AWAY)):
        for noise_deg in NOISE_DEG:
            errors = []
            for survey, queries in sets:
                spread = float(np.sqrt(survey.center.var(axis=0).sum()))
                offset = np.array([factor * spread, 0.0, 0.0])
                for i, query in enumerate(queries):
                    anchors = moved(nearest(survey, query, 20), offset)
                    rng = np.random.default_rng(i)
                    errors.append(measure(anchors, moved(query, offset), noise_deg, rng))
            medians = np.median(errors, axis=0)
            by_noise.append([where, f"{noise_deg:g}", *(f"{100 * m:.2f}" for m in medians)])
    tables = [markdown(["world's origin", "noise (deg)", *AVERAGES], by_noise)]
    large = [(survey, queries) for survey, queries in sets if len(survey) >= MIN_ANCHORS]
    if not large:
        return tables[0]
    by_number = []
    for wrong_share in WRONG_SHARES:
        for num in NUM_ANCHORS:
            errors = [
                measure(nearest(survey, query, num), query, 1.0, rng, wrong_share)
                for survey, queries in large
                for i, query in enumerate(queries)
                for rng in [np.random.default_rng(i)]
                for _ in range(NUM_DRAWS)
            ]
            medians = np.median(errors, axis=0)
            by_number.append([f"{wrong_share:.0%}", f"{num}", *(f"{100 * m:.2f}" for m in medians)])
    tables.append(markdown(["wrong", "anchors", *AVERAGES], by_number))
    return "\n\n".join(tables)
