"""A new survey brought into a map's frame, by localizing some of its images there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from trigpoint.errors import ConfigError
from trigpoint.frame import Failed, Localized, Lost
from trigpoint.geometry.similarity import SimilarityConsensus, estimate_similarity
from trigpoint.localizer import Localizer
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.localize import Outcome, localize_images
from trigpoint_db.poses import Query
from trigpoint_db.sampling import spread_indices

MIN_AGREEING = 5
MIN_SHARE = 0.5  # of the localized images: a second similarity cannot have as many


@dataclass(frozen=True, eq=False)
class Alignment:
    """The similarity that takes a survey into a map, and how well it fits."""

    consensus: SimilarityConsensus
    num_tried: int

    def move(self, images: Iterable[PosedImage]) -> list[PosedImage]:
        """Return images of the survey with their poses in the map."""
        map_from_survey = self.consensus.b_from_a
        return [
            replace(image, cam_from_world=map_from_survey.move(image.cam_from_world))
            for image in images
        ]

    def to_json(self) -> dict[str, Any]:
        """Say in JSON's types what was found; residuals are those of the images that agree."""
        found = self.consensus
        positions = found.position_errors[found.inliers]
        rotations_deg = np.rad2deg(found.rotation_errors_rad[found.inliers])
        return {
            "num_tried": self.num_tried,
            "num_localized": len(found.inliers),
            "num_agreeing": int(found.inliers.sum()),
            "scale": found.b_from_a.scale,
            "rotation_deg": float(np.rad2deg(rotation_angle(found.b_from_a.R))),
            "R": found.b_from_a.R.tolist(),
            "t": found.b_from_a.t.tolist(),
            "median_position": float(np.median(positions)),
            "p90_position": float(np.percentile(positions, 90)),
            "median_rotation_deg": float(np.median(rotations_deg)),
            "p90_rotation_deg": float(np.percentile(rotations_deg, 90)),
        }


def align_survey(
    localizer: Localizer,
    images: Sequence[PosedImage],
    folder: Path,
    *,
    max_error: float,
    track: Callable[[Iterable[Outcome], int], Iterable[Outcome]],
) -> Alignment:
    """Localize images of a survey in a map and find the similarity that most of them agree on.

    An image agrees if its position is off by no more than the share `max_error` of its distance to
    what it shows, and its rotation by no more than as many radians: what it shows then moves by as
    much in the image. Too few that agree are a ConfigError.
    """
    queries = [Query(image.name, image.camera) for image in images]
    outcomes = track(localize_images(localizer, queries, folder), len(queries))
    results = [outcome.result for outcome in outcomes]
    localized = [
        (image.cam_from_world, result.cam_from_world, result.statistics.depth)
        for image, result in zip(images, results, strict=True)
        if isinstance(result, Localized)
    ]
    if len(localized) < MIN_AGREEING:
        lost = Counter(f"{r.reason}: {r.detail}" for r in results if isinstance(r, Lost | Failed))
        why = f" ({lost.most_common(1)[0][0]})" if lost else ""
        raise ConfigError(
            f"{len(localized)} of {len(images)} images of the survey were localized in the map"
            f"{why}; {MIN_AGREEING} are needed: does it show the same place, with these cameras?"
        )
    in_survey, in_map, depths = zip(*localized, strict=True)
    consensus = estimate_similarity(
        Rigid3.stack(in_survey),
        Rigid3.stack(in_map),
        max_position_error=max_error * np.array(depths),
        max_rotation_error_rad=max_error,
    )
    num_agreeing = 0 if consensus is None else int(consensus.inliers.sum())
    if consensus is None or num_agreeing < max(MIN_AGREEING, MIN_SHARE * len(localized)):
        raise ConfigError(
            f"{num_agreeing} of {len(localized)} localized images agree on where the survey lies "
            f"in the map, too few to trust: are its poses right? Where they drift, align parts of "
            f"it, or allow more than --max-error {max_error:g}"
        )
    return Alignment(consensus, len(images))


def choose_spread(images: Sequence[PosedImage], num: int) -> list[PosedImage]:
    """Choose so many images, spread over the survey, in order of their names."""
    images = sorted(images, key=lambda image: image.name)
    return [images[i] for i in spread_indices(len(images), num)]
