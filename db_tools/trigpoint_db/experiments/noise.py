"""Center averaging and translation averaging under noise: the paper's figure "noise".

A query amid anchors whose relative poses are the true ones, each perturbed as (N_R R, N_T T): N_R
and N_T turn by Gaussian rotation vectors. The paper does not say which relative pose (R, T) is, and
it matters: of the query in the anchor, (R_kq, T_kq) of eq. 9, or of the anchor in the query,
(R_qk, T_qk) of eq. 3, whose direction in the anchor errs by both noises. Here are both.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from trigpoint.rigid import Rigid3, rotate, rotation_from_vector
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import markdown, number
from trigpoint_db.figures import make_figure, save_figure

Array = NDArray[np.float64]

NUM_ANCHORS = 20
NOISE_DEG = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0)
IN_ANCHOR, IN_QUERY = "(R_kq, T_kq)", "(R_qk, T_qk)"
PERTURBED = {IN_ANCHOR: "of the query in the anchor", IN_QUERY: "of the anchor in the query"}
# What is perturbed, and how far the world's origin is from the scene's middle, in its radii.
SETUPS = ((IN_ANCHOR, 0.0), (IN_QUERY, 0.0), (IN_ANCHOR, 3.0))
NOISES = {"rotation": (1.0, 0.0), "translation": (0.0, 1.0), "both": (1.0, 1.0)}
AT_QUERY = "at the query"
ORIGINS = (AT_QUERY, 0.0, 1.0, 3.0, 10.0, 30.0)
ORIGIN_NOISE_DEG = 1.0
NUM_RESAMPLES = 1000
SEED = 0

OURS = "center, least squares"
ROBUST = "center, robust"
CLOSED_FORM = "translation, closed form"
GOVINDU = "translation, Govindu"
METHODS = (OURS, ROBUST, CLOSED_FORM, GOVINDU)
DUELS = tuple(itertools.product((OURS, ROBUST), (CLOSED_FORM, GOVINDU)))
HOLDS = "better at all, the gap grows"
SAME = 1e-6  # of a median: no difference but rounding
COLORS = dict(zip(METHODS, ("tab:blue", "tab:cyan", "tab:orange", "tab:red"), strict=True))


def estimate_centers(anchors: Rigid3, query_from_anchors: Rigid3) -> dict[str, Array | None]:
    """Return the query's center by each method from the same relative poses (K,)."""
    directions = center_directions(anchors, query_from_anchors)
    R = average_rotations(query_from_anchors.R @ anchors.R)

    def center_of(average: Callable[[Rigid3, Rigid3], Array | None]) -> Array | None:
        T_q = average(anchors, query_from_anchors)
        return None if T_q is None else -R.T @ T_q

    return {
        OURS: average_centers(anchors.center, directions),
        ROBUST: average_centers_robust(anchors.center, directions),
        CLOSED_FORM: center_of(average_translations),
        GOVINDU: center_of(average_translations_govindu),
    }


def measure(num_trials: int, store: Store) -> dict[str, Any]:
    """Measure every kind and level of noise, each method on the same draws."""
    settings = {"num_trials": num_trials, "num_anchors": NUM_ANCHORS, "seed": SEED}
    store.begin("noise", settings)
    levels = [
        (perturbed, noise, noise_deg, origin)
        for (perturbed, origin), noise, noise_deg in itertools.product(SETUPS, NOISES, NOISE_DEG)
    ]
    origins = [(IN_ANCHOR, "both", ORIGIN_NOISE_DEG, origin) for origin in ORIGINS]
    runs = {" ".join(map(str, run)): run for run in (*levels, *origins)}
    for key in store.each(list(runs), "noise"):
        errors = run_trials(num_trials, *runs[key])
        store[key] = {
            name: summarize(column) for name, column in zip(METHODS, errors.T, strict=True)
        }

    def rows(of: Sequence[tuple[str, str, float, float | str]]) -> list[dict[str, Any]]:
        names = "perturbed", "noise", "noise_deg", "origin"
        return [
            dict(zip(names, run, strict=True)) | {"percent": store[" ".join(map(str, run))]}
            for run in of
        ]

    return {**settings, "levels": rows(levels), "origins": rows(origins)}


def run_trials(
    num_trials: int, perturbed: str, noise: str, noise_deg: float, origin: float | str
) -> Array:
    """Errors (T, M) of the methods, in percent of the anchors' median distance.

    The seed is the same for each call: another level of noise has the same cameras and the same
    noise, but larger.
    """
    rng = np.random.default_rng(SEED)
    shape = num_trials, NUM_ANCHORS
    R, R_q = (rotation_from_vector(rng.normal(size=(*s, 3))) for s in (shape, (num_trials, 1)))
    centers, center_q, offset = (
        rng.normal(size=(num_trials, num, 3)) for num in (NUM_ANCHORS, 1, 1)
    )
    for points in (centers, center_q):  # within a ball
        points *= np.cbrt(rng.random((*points.shape[:2], 1))) / _lengths(points)
    distances = _lengths(centers - center_q)
    offset = -center_q if isinstance(origin, str) else offset * origin / _lengths(offset)
    centers, center_q = centers + offset, center_q + offset
    turns = rng.normal(size=(2, *shape, 3)) * np.deg2rad(noise_deg)
    N_R, N_T = (
        rotation_from_vector(share * turn) for share, turn in zip(NOISES[noise], turns, strict=True)
    )
    anchors = Rigid3.from_center(R, centers)
    relative = Rigid3.from_center(R_q, center_q) @ anchors.inverse()  # query_from_anchors
    if perturbed == IN_QUERY:
        relative = Rigid3(N_R @ relative.R, rotate(N_T, relative.t))
    else:
        inverse = relative.inverse()
        relative = Rigid3(N_R @ inverse.R, rotate(N_T, inverse.t)).inverse()
    errors = [
        [
            np.inf if center is None else float(np.linalg.norm(center - center_q[trial, 0]))
            for center in estimate_centers(anchors[trial], relative[trial]).values()
        ]
        for trial in range(num_trials)
    ]
    return 100 * np.array(errors) / np.median(distances, axis=(1, 2))[:, None]


def _lengths(vectors: Array) -> Array:
    lengths: Array = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return lengths


def summarize(errors: Array) -> dict[str, float]:
    """Return the median of errors (T,) and, by bootstrap, where it is with 95 % confidence."""
    rng = np.random.default_rng(SEED)
    samples = rng.integers(0, len(errors), (NUM_RESAMPLES, len(errors)))
    low, high = np.percentile(np.median(errors[samples], axis=1), [2.5, 97.5])
    return {"median": float(np.median(errors)), "low": float(low), "high": float(high)}


def write_table(result: Mapping[str, Any]) -> str:
    """Write the tables, and what they say of the paper's claim."""
    introduction = (
        f"{result['num_anchors']} anchors and the query stand anywhere in a ball and look "
        "anywhere; the relative pose of each anchor is perturbed. Medians of "
        f"{result['num_trials']} trials in percent of the anchors' median distance from the query, "
        "with the 95 % interval of a bootstrap. The draws are the same for all methods and levels."
    )
    parts = [introduction]
    for perturbed, origin in SETUPS:
        rows = [
            [noise, number(noise_deg), *_cells(percent)]
            for noise in NOISES
            for noise_deg, percent in _levels(result, perturbed, origin, noise)
        ]
        parts.append(
            f"{describe_setup(perturbed, origin)}:\n\n"
            + markdown(["noise of", "degrees", *METHODS], rows)
        )
    verdicts, num_holding = [], 0
    for (perturbed, origin), noise in itertools.product(SETUPS, NOISES):
        levels = [percent for _, percent in _levels(result, perturbed, origin, noise)]
        found = [compare(levels, ours, theirs) for ours, theirs in DUELS]
        num_holding += sum(verdict == HOLDS for verdict in found)
        verdicts.append([f"{perturbed}, origin {origin:g}", noise, *found])
    parts.append(
        "Does center averaging beat translation averaging at every level, with a gap that grows "
        f"with the noise, as the paper finds? In {num_holding} of {len(verdicts) * len(DUELS)} "
        "comparisons of medians:\n\n"
        + markdown(["perturbed", "noise of", *(" against ".join(d) for d in DUELS)], verdicts, 6)
    )
    cells = [
        [
            row["origin"] if row["origin"] == AT_QUERY else number(row["origin"]),
            *_cells(row["percent"]),
        ]
        for row in result["origins"]
    ]
    first = result["origins"][0]
    parts.append(
        f"Translation averaging depends on where the world's origin is. With {first['noise']} "
        f"noises of {number(first['noise_deg'])} degree on {first['perturbed']}, by its distance "
        "from the ball's center in radii:\n\n" + markdown(["origin", *METHODS], cells)
    )
    return "\n\n".join(parts)


def describe_setup(perturbed: str, origin: float) -> str:
    """Say what is perturbed, and where the origin is."""
    where = f"{origin:g} radii from the ball's center" if origin else "at the ball's center"
    return f"Perturbed is {perturbed}, the pose {PERTURBED[perturbed]}; the origin is {where}"


def compare(levels: Sequence[Mapping[str, Mapping[str, float]]], ours: str, theirs: str) -> str:
    """Say whether one method is better at each level of noise, and ever more so."""
    gaps = [level[theirs]["median"] - level[ours]["median"] for level in levels]
    if all(
        abs(gap) < SAME * level[ours]["median"] for gap, level in zip(gaps, levels, strict=True)
    ):
        return "the same"
    num_better = sum(gap > 0 for gap in gaps)
    if num_better < len(gaps):
        return f"better at {num_better} of {len(gaps)}" if num_better else "worse at all"
    grows = all(after > before for before, after in itertools.pairwise(gaps))
    return HOLDS if grows else "better at all, the gap does not grow steadily"


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw a panel for each kind of noise: medians with their confidence intervals."""
    figure = make_figure(8, 7)
    panels = figure.subplots(len(SETUPS), len(NOISES), sharex=True, sharey="row")
    for axes_row, (perturbed, origin) in zip(panels, SETUPS, strict=True):
        for axes, noise in zip(axes_row, NOISES, strict=True):
            levels = _levels(result, perturbed, origin, noise)
            noise_deg = [level for level, _ in levels]
            for method, color in COLORS.items():
                low, median, high = (
                    [percent[method][key] for _, percent in levels]
                    for key in ("low", "median", "high")
                )
                style = "--" if method == CLOSED_FORM else "-"  # which hides what it equals
                axes.plot(noise_deg, median, style, color=color, marker=".", label=method)
                axes.fill_between(noise_deg, low, high, color=color, alpha=0.2, linewidth=0)
            axes.set_title(f"{perturbed}, origin {origin:g}: {noise}", fontsize="small")
            axes.grid(alpha=0.3)
        axes_row[0].set_ylim(bottom=0)
    figure.supxlabel("noise (degrees, standard deviation about each axis)")
    figure.supylabel("median position error (% of the anchors' distance)")
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    save_figure(figure, path)


def _levels(
    result: Mapping[str, Any], perturbed: str, origin: float, noise: str
) -> list[tuple[float, Mapping[str, Mapping[str, float]]]]:
    """List degrees of noise, and what each method makes of them."""
    return [
        (row["noise_deg"], row["percent"])
        for row in result["levels"]
        if (row["perturbed"], row["origin"], row["noise"]) == (perturbed, origin, noise)
    ]


def _cells(percent: Mapping[str, Mapping[str, float]]) -> list[str]:
    points = [percent[method] for method in METHODS]
    return [f"{p['median']:.2f} ({p['low']:.2f} to {p['high']:.2f})" for p in points]
