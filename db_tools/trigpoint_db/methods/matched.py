"""A frame matched with its anchors: what all methods start from."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.frame import Anchor, Frame, LocalFeatures, Lost, Prior, Reason, Statistics
from trigpoint.localizer import Localizer
from trigpoint.models.matching import Matcher
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import Query, estimate_relative_poses, match_anchors


@dataclass(frozen=True, eq=False)
class Matched:
    """A frame's features and their matches in all of its anchors.

    Parameters
    ----------
    camera : Camera
    features : LocalFeatures
    anchors : list of Anchor
        The most similar first (K,).
    query : Query
        Their matches, one set an anchor.
    matcher : Matcher
        What made these.
    statistics : Statistics
        Counts and times so far.
    """

    camera: Camera
    features: LocalFeatures
    anchors: list[Anchor]
    query: Query
    matcher: Matcher
    statistics: Statistics


# Gives cam_from_world, or why there is none.
Method = Callable[[Matched, LocalizerOptions], Rigid3 | Reason]


def match_frame(localizer: Localizer, frame: Frame, prior: Prior | None = None) -> Matched | Lost:
    """Match a frame with all of its anchors at once, as a localizer of one round would."""
    options, stage_ms = localizer.options, dict[str, float]()
    with timed(localizer, stage_ms, "features"):
        features = localizer.model.extract(frame.image, options.max_keypoints)
    if len(features) < options.min_features:
        statistics = Statistics(num_features=len(features), stage_ms=stage_ms)
        return Lost(Reason.FEW_FEATURES, statistics, f"{len(features)} keypoints")
    with timed(localizer, stage_ms, "retrieval"):
        indices, _ = localizer.reader.search(
            features.global_descriptor, options.num_anchors, options.anchor_diversity, prior=prior
        )
    if len(indices) == 0:
        statistics = Statistics(num_features=len(features), stage_ms=stage_ms)
        return Lost(Reason.FEW_ANCHORS, statistics, "the map holds no image that may be used")
    with timed(localizer, stage_ms, "matching"):
        anchors = [localizer.reader.anchor(index) for index in indices.tolist()]
        query = match_anchors(
            frame.camera, features, anchors, localizer.matcher, localizer.model.long_side_px
        )
    statistics = Statistics(
        num_features=len(features),
        num_anchors=len(anchors),
        num_matches=len(query.tracks),
        num_matcher_failures=query.num_matcher_failures,
        anchors=tuple(anchor.name for anchor in anchors),
        stage_ms=stage_ms,
    )
    return Matched(frame.camera, features, anchors, query, localizer.matcher, statistics)


def estimate_each_relative_pose(
    matched: Matched, options: LocalizerOptions
) -> tuple[NDArray[np.intp], Rigid3]:
    """Estimate the relative poses of all anchors, not only of the best."""
    every = replace(options, num_relative_poses=len(matched.anchors))
    return estimate_relative_poses(matched.query, every)


@contextmanager
def timed(localizer: Localizer, stage_ms: dict[str, float], name: str) -> Iterator[None]:
    """Note how long a stage takes, where the localizer has a clock."""
    start = localizer.clock() if localizer.clock else 0.0
    yield
    if localizer.clock:
        stage_ms[name] = (localizer.clock() - start) * 1e3
