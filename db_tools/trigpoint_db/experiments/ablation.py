"""What each of our departures from the paper brings: each is taken back, one at a time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trigpoint.frame import Localized
from trigpoint.geometry.joint_refinement import RefinedPose
from trigpoint.geometry.pose_refinement import refine_pose
from trigpoint.geometry.triangulation import LatentPoints
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import Query
from trigpoint_db import poses
from trigpoint_db.build import read_frame
from trigpoint_db.experiments.averaging import describe_choice
from trigpoint_db.experiments.sets import choose, identify, open_map
from trigpoint_db.experiments.store import Store
from trigpoint_db.experiments.tables import geometric_mean, markdown, median, number
from trigpoint_db.figures import make_figure, save_figure, scale_logarithmically
from trigpoint_db.importers.base import Dataset


class PlainRefinement(Localizer):
    """Refines as the paper does: points by E1, then the pose by E2 alone, unweighted."""

    def refine(
        self, query: Query, cam_from_world: Rigid3
    ) -> tuple[LatentPoints, RefinedPose | None]:
        """Put the pose of E2 in the place of the one refined jointly, whose verdict it gets."""
        latent, refined = super().refine(query, cam_from_world)
        if refined is None:
            return latent, None
        plain = refine_pose(
            cam_from_world,
            latent.points3d,
            query.points[latent.point],
            sigma=self.options.keypoint_sigma_px * query.px,
            max_error=self.options.max_reprojection_error_px * query.px,
        )
        return latent, None if plain is None else replace(refined, cam_from_world=plain)


@dataclass(frozen=True)
class Variant:
    """A localizer with something taken back."""

    options: LocalizerOptions
    kind: type[Localizer] = Localizer
    is_float: bool = False


OPTIONS = LocalizerOptions()
NOTABLE = 0.05
EXACT = replace(OPTIONS, anchor_position_noise=2e-6, anchor_rotation_noise_deg=2e-6)
AS_IT_IS, FLOAT, PAPER = "as it is", "network in FP32, not INT8", "all of the paper's at once"
VARIANTS = {
    AS_IT_IS: Variant(OPTIONS),
    "least squares, no robust center": Variant(replace(OPTIONS, center="least_squares")),
    "anchor pairs, no latent points first": Variant(replace(OPTIONS, generator="anchor_pairs")),
    "anchor pairs, and least squares": Variant(
        replace(OPTIONS, generator="anchor_pairs", center="least_squares")
    ),
    "anchors' poses exact": Variant(EXACT),
    "anchors' poses exact, E1 then E2 unweighted": Variant(EXACT, PlainRefinement),
    "all matches, not the guided": Variant(replace(OPTIONS, max_guided_error_px=1e5)),
    "6 anchors, no second round": Variant(replace(OPTIONS, num_anchors=OPTIONS.first_anchors)),
    "20 anchors at once, no adaptive K": Variant(
        replace(OPTIONS, first_anchors=OPTIONS.num_anchors)
    ),
    "most similar anchors, not diverse": Variant(replace(OPTIONS, anchor_diversity=0.0)),
    FLOAT: Variant(OPTIONS, is_float=True),
    PAPER: Variant(
        replace(
            EXACT,
            first_anchors=OPTIONS.num_anchors,
            num_relative_poses=OPTIONS.num_anchors,
            num_refined_anchors=OPTIONS.num_anchors,
            anchor_diversity=0.0,
            generator="anchor_pairs",
            center="least_squares",
        ),
        PlainRefinement,
    ),
}


def measure(
    sets: Mapping[str, Dataset],
    network: FeatureModel,
    float_network: FeatureModel | None,
    max_queries: int,
    store: Store,
) -> dict[str, Any]:
    """Localize queries of each set with every variant; `float_network` is the same in FP32."""
    networks = {False: network, True: float_network}
    variants = {label: variant for label, variant in VARIANTS.items() if networks[variant.is_float]}
    queries = {name: choose(dataset.queries, max_queries) for name, dataset in sets.items()}
    keys = {name: [f"{name}: {query.name}" for query in chosen] for name, chosen in queries.items()}
    store.begin(
        "ablation",
        {
            "variants": {label: str(variant) for label, variant in variants.items()},
            "networks": [each.identity.sha256 for each in networks.values() if each],
            "queries": keys,
        }
        | identify(network, sets),
    )
    for name, dataset in sets.items():
        if all(key in store for key in keys[name]):
            continue
        by_key = dict(zip(keys[name], queries[name], strict=True))
        with ExitStack() as stack:
            readers = {
                is_float: stack.enter_context(open_map(store.folder / "maps", name, dataset, each))
                for is_float, each in networks.items()
                if each
            }
            localizers = {
                label: variant.kind(
                    networks[variant.is_float] or network,
                    readers[variant.is_float],
                    variant.options,
                )
                for label, variant in variants.items()
            }
            for key in store.each(keys[name], name):
                first = keys[name].index(key) % len(localizers)
                store[key] = localize(localizers, dataset, by_key[key], first)
    return {
        "network": network.identity.name,
        "max_queries": max_queries,
        "variants": list(variants),
        "rows": [
            {
                "set": name,
                "num_queries": len(dataset.queries),
                "num_chosen": len(queries[name]),
                "variants": summarize([store[key] for key in keys[name]], list(variants)),
            }
            for name, dataset in sets.items()
        ],
    }


def localize(
    localizers: Mapping[str, Localizer], dataset: Dataset, query: poses.Query, first: int
) -> dict[str, dict[str, float | None]]:
    """Return each localizer's position error, None where the query is lost, and its time.

    They take turns at being first, which is slower: caches are cold.
    """
    frame = read_frame(dataset.images, query.name, query.camera)
    truth, found = dataset.truth[query.name], dict[str, dict[str, float | None]]()
    turns = list(localizers.items())
    for label, localizer in turns[first:] + turns[:first]:
        start = time.perf_counter()
        result = localizer.localize(frame)
        ms = 1e3 * (time.perf_counter() - start)
        error = (
            float(np.linalg.norm(result.cam_from_world.center - truth.center))
            if isinstance(result, Localized)
            else None
        )
        found[label] = {"error": error, "ms": ms}
    return found


def summarize(
    units: list[dict[str, dict[str, float | None]]], variants: list[str]
) -> dict[str, Any]:
    """Return the percentiles of each variant; lost queries have infinite errors."""
    return {
        label: {
            "median": median([unit[label]["error"] for unit in units]),
            "p90": median([unit[label]["error"] for unit in units], 90),
            "num_lost": sum(unit[label]["error"] is None for unit in units),
            "ms": median([unit[label]["ms"] for unit in units]),
        }
        for label in variants
    }


def ratios(result: Mapping[str, Any], variant: str, key: str) -> list[float | None]:
    """Return a number of a variant over that of the localizer as it is, for each set."""
    return [
        of / reference if of and reference else None
        for row in result["rows"]
        for of, reference in [(row["variants"][variant][key], row["variants"][AS_IT_IS][key])]
    ]


def write_table(result: Mapping[str, Any]) -> str:
    """Write what each variant costs, over all sets, and the medians of each set."""
    rows, variants = result["rows"], result["variants"]
    num_queries = sum(row["num_chosen"] for row in rows)
    overall = [
        [
            variant,
            *(number(geometric_mean(ratios(result, variant, key))) for key in ("median", "p90")),
            f"{sum(row['variants'][variant]['num_lost'] for row in rows)} of {num_queries}",
            number(geometric_mean(ratios(result, variant, "ms"))),
        ]
        for variant in variants
    ]
    costs = {
        variant: geometric_mean(ratios(result, variant, "median"))
        for variant in variants
        if variant != AS_IT_IS
    }
    worse = [variant for variant, cost in costs.items() if cost and cost > 1 + NOTABLE]
    better = [variant for variant, cost in costs.items() if cost and cost < 1 - NOTABLE]
    by_set = [
        [row["set"], *(number(row["variants"][variant]["median"]) for variant in variants)]
        for row in rows
    ]
    verdict = (
        f"By more than {NOTABLE:.0%} in the median, worse: {'; '.join(worse) or 'none'}. "
        f"Better: {'; '.join(better) or 'none'}."
    )
    absent = "" if FLOAT in variants else f" Not measured: {FLOAT} (`--fp32` was not given)."
    return "\n\n".join(
        [
            f"One departure after the other taken back, {len(rows)} sets and splits. Ratios to the "
            "localizer as it is: geometric means of those of the medians and of the 90th "
            "percentiles of the position errors, where both are finite (lost queries have "
            "infinite errors), and of the median times. What covariance weights bring is the "
            f"difference between the two rows with exact poses; {PAPER!r} keeps the guided "
            f"matches, INT8 and {OPTIONS.num_anchors} anchors.{absent}" + describe_choice(result),
            markdown(["taken back", "median", "90th percentile", "lost", "time"], overall),
            verdict,
            "The medians:",
            markdown(["set", *variants], by_set),
        ]
    )


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Draw the ratios of the medians: each set a dot, their geometric mean a line."""
    variants = [variant for variant in result["variants"] if variant != AS_IT_IS]
    figure = make_figure(8, 1 + 0.35 * len(variants))
    axes = figure.subplots()
    for place, variant in enumerate(variants):
        known = [ratio for ratio in ratios(result, variant, "median") if ratio is not None]
        mean = geometric_mean(known)
        axes.plot(known, [place] * len(known), "o", color="tab:blue", alpha=0.4, markeredgewidth=0)
        if mean is not None:
            axes.plot([mean], [place], "|", color="black", markersize=16, markeredgewidth=2)
    axes.axvline(1, color="gray", linewidth=0.8)
    axes.set_yticks(range(len(variants)), variants)
    axes.invert_yaxis()
    scale_logarithmically(axes)
    axes.set_xlabel("median position error over that of the localizer as it is, each set a dot")
    axes.grid(axis="x", which="both", alpha=0.3)
    save_figure(figure, path)
