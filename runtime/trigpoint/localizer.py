"""Frame in, pose out: the paper's pipeline, top to bottom.

A function of the frame, the map's snapshot and the options. It has no clock of its own: stage times
are measured, and a deadline is kept, with the caller's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.frame import (
    Frame,
    LocalFeatures,
    Localized,
    Lost,
    Prior,
    Reason,
    Result,
    Statistics,
)
from trigpoint.geometry.joint_refinement import RefinedPose
from trigpoint.geometry.triangulation import LatentPoints
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import Matcher, MutualNearestNeighbors
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import (
    UNMEASURED,
    Query,
    average_poses,
    calibrate_covariance,
    count_by_anchor,
    count_support,
    estimate_relative_poses,
    extract_turned,
    find_latent_points,
    find_support,
    match_anchors,
    mean_distance,
    refine,
    solve_latent_points,
)
from trigpoint.verdict import gather_evidence, judge, measure_confidence, see_share

MIN_CONTRAST = 2.0  # standard deviation of the gray levels
GROWTH = 3  # each round has so many times the anchors of the one before
NUM_LOOK_ALIKE = 20  # images that are looked at for doubles
MAX_SHOWN = 200  # points that images are asked for
MAX_LESS_ALIKE = 0.1  # in cosine, than the best anchor
MAX_DEPTHS = 10  # times the frame's median depth: from farther away nothing can be made out
MIN_SEEN_SHARE = 0.1  # of what the frame was localized by, for an image of the same place


@dataclass(frozen=True, eq=False)
class Solution:
    """What comes of a query's matches.

    Parameters
    ----------
    result : Localized or Lost
    is_certain : bool
        More anchors are not needed.
    refined : RefinedPose, optional
        The pose that was given, with the covariance of the images alone.
    seen : LatentPoints, optional
        What it was localized by.
    max_distance : float
        From farther away nothing of that can be made out.
    """

    result: Result
    is_certain: bool = False
    refined: RefinedPose | None = None
    seen: LatentPoints | None = None
    max_distance: float = math.inf


class Localizer:
    """Localizes frames against one snapshot of a map.

    Parameters
    ----------
    model : FeatureModel
        The network.
    reader : MapReader
        The map, made with the same network.
    options : LocalizerOptions, optional
    clock : callable, optional
        Seconds, monotonic; without it the results have no stage times, and there is no deadline.
    matcher : Matcher, optional
        Mutual nearest neighbours by default, and where it fails.
    """

    def __init__(
        self,
        model: FeatureModel,
        reader: MapReader,
        options: LocalizerOptions | None = None,
        clock: Callable[[], float] | None = None,
        matcher: Matcher | None = None,
    ) -> None:
        self.model = model
        self.reader = reader
        self.options = options or LocalizerOptions()
        self.clock = clock
        self.matcher = matcher or MutualNearestNeighbors()

    def check_sessions(self) -> None:
        """Raise ConfigError where the options name a session that the map does not have."""
        known = {session.name for session in self.reader.sessions}
        for option in ("prefer_sessions", "exclude_sessions"):
            for name in getattr(self.options, option):
                if name not in known:
                    raise ConfigError(
                        f"{option} has {name!r}, a session that the map does not have; "
                        f"it has {', '.join(sorted(known)) or 'none'}"
                    )

    def localize(self, frame: Frame, prior: Prior | None = None) -> Result:
        """Estimate cam_from_world of a frame, with covariance, or say why not.

        With a prior position, images from elsewhere are not tried first; they still count against a
        pose that they would explain as well, so that a wrong prior makes no wrong pose.
        With `try_turned`, a frame that is lost as it is is also tried on its sides and upside down.
        """
        deadline = _Deadline(self.clock, self.options.max_latency_ms)
        result = self._localize(frame, prior, Statistics(), deadline)
        if isinstance(result, Localized) or not self.options.try_turned:
            return result
        if result.reason in (Reason.NO_MAP, Reason.TOO_DARK, Reason.FEW_FEATURES):
            return result
        for turned_deg in (90, 180, 270):
            if deadline.is_over():
                break
            start = Statistics(turned_deg=turned_deg, stage_ms=result.statistics.stage_ms)
            turned = self._localize(frame, prior, start, deadline)
            if isinstance(turned, Localized):
                return turned
        return result

    def solve(self, query: Query) -> Solution:
        """Solve for the pose with the anchors that a query is matched with, all at once."""
        return self._solve(query, True, _Trace(self.clock, Statistics()))

    def refine(
        self, query: Query, cam_from_world: Rigid3
    ) -> tuple[LatentPoints, RefinedPose | None]:
        """Refine a hypothesis; a subclass may do so in another way, to compare."""
        return refine(query, cam_from_world, self.options)

    def _localize(
        self, frame: Frame, prior: Prior | None, statistics: Statistics, deadline: _Deadline
    ) -> Result:
        options, trace = self.options, _Trace(self.clock, statistics)
        if len(self.reader) == 0:
            return trace.lost(Reason.NO_MAP, "the map holds no image")
        if (contrast := cv2.meanStdDev(frame.image)[1].item()) < MIN_CONTRAST:
            return trace.lost(Reason.TOO_DARK, f"contrast {contrast:.1f} gray levels")

        with trace.stage("features"):
            features = extract_turned(
                self.model, frame.image, options.max_keypoints, statistics.turned_deg
            )
        trace.note(num_features=len(features))
        if len(features) < options.min_features:
            return trace.lost(Reason.FEW_FEATURES, f"{len(features)} keypoints")

        with trace.stage("retrieval"):
            indices, similarities = self.reader.search(
                features.global_descriptor,
                options.num_anchors,
                options.anchor_diversity,
                prefer=options.prefer_sessions,
                exclude=options.exclude_sessions,
                prior=prior,
            )
        if len(indices) < 2:
            around = " around the prior position" if prior else ""
            detail = f"{len(indices)} images of the map may be used{around}; a pose takes 2"
            return trace.lost(Reason.FEW_ANCHORS, detail)
        retrieved = dict(zip(indices.tolist(), similarities.tolist(), strict=True))
        return self._solve_in_rounds(frame, features, retrieved, trace, deadline)

    def _solve_in_rounds(
        self,
        frame: Frame,
        features: LocalFeatures,
        retrieved: dict[int, float],
        trace: _Trace,
        deadline: _Deadline,
    ) -> Result:
        """Take anchors, best first, until the pose is certain, or they or the time run out.

        What is found is tried again with the images of other places that look as much like the
        frame, while there are any.
        """
        options, query = self.options, None
        waiting, taken = list(retrieved), list[int]()
        batch = waiting[: _round_size(0, len(waiting), options.first_anchors)]
        while True:
            deadline.start_round()
            with trace.stage("matching"):
                anchors = [self.reader.anchor(index) for index in batch]
                more = match_anchors(
                    frame.camera, features, anchors, self.matcher, self.model.long_side_px
                )
                query = query.joined(more) if query else more
            taken += batch
            waiting = [index for index in waiting if index not in batch]
            trace.note(
                num_anchors=len(taken),
                num_matches=len(query.tracks),
                num_matcher_failures=query.num_matcher_failures,
                anchors=trace.statistics.anchors + tuple(anchor.name for anchor in anchors),
            )
            solution = self._solve(query, not waiting, trace)
            if not waiting or solution.is_certain:
                with trace.stage("doubles"):
                    batch = self._find_doubles(features, taken, retrieved, solution)
                waiting = []
            else:
                batch = waiting[: _round_size(len(taken), len(waiting), options.first_anchors)]
            if not batch or deadline.leaves_no_time(1 + len(batch) / len(taken)):
                return solution.result

    def _find_doubles(
        self,
        features: LocalFeatures,
        taken: list[int],
        retrieved: dict[int, float],
        solution: Solution,
    ) -> list[int]:
        """Find images of other places, if one of them looks as much like the frame as the anchors.

        Of other places are images that do not see what the frame was localized by.
        """
        if solution.seen is None:
            return []
        points3d = solution.seen.points3d
        points3d = points3d[:: math.ceil(len(points3d) / MAX_SHOWN)]
        support = [retrieved.get(taken[view], 0.0) for view in np.unique(solution.seen.tracks.view)]
        found, similarities = self.reader.search(
            features.global_descriptor, NUM_LOOK_ALIKE, exclude=self.options.exclude_sessions
        )
        num_alike = int((similarities > max(support) - MAX_LESS_ALIKE).sum())
        elsewhere: list[int] = []
        for i, index in enumerate(found.tolist()):
            if i >= num_alike and not elsewhere:
                break
            seen = see_share(*self.reader.view(index), points3d, solution.max_distance)
            if seen < MIN_SEEN_SHARE:
                elsewhere.append(index)
        return [index for index in elsewhere if index not in taken][: self.options.first_anchors]

    def _solve(self, query: Query, is_last: bool, trace: _Trace) -> Solution:
        """Solve for the pose with the anchors there are."""
        options = self.options
        with trace.stage("latent_points"):
            latent = find_latent_points(query, options)
        num_candidates = len(latent.point)
        trace.note(num_candidates=num_candidates)
        if num_candidates < options.min_inliers:
            detail = f"{num_candidates} points in two anchors"
            return Solution(trace.lost(Reason.FEW_MATCHES, detail))

        hypotheses: list[tuple[int, str, Rigid3]] = []  # supporters, generator, cam_from_world
        refusal = Reason.FEW_INLIERS
        if options.generator != "anchor_pairs":
            with trace.stage("absolute_pose"):
                solved = solve_latent_points(query, latent, options)
                if solved is not None:
                    support = count_support(query, latent, solved, options)
                    hypotheses.append((support, "latent_points", solved))
        if options.generator == "anchor_pairs" or (
            options.generator == "best"
            and is_last
            and (not hypotheses or hypotheses[0][0] < options.min_support)
        ):
            with trace.stage("relative_poses"):
                chosen, query_from_anchors = estimate_relative_poses(query, options)
            with trace.stage("averaging"):
                averaged = average_poses(query.views[chosen], query_from_anchors, options)
                if isinstance(averaged, Reason):
                    refusal = averaged
                else:
                    support = count_support(query, latent, averaged[0], options)
                    hypotheses.append((support, "anchor_pairs", averaged[0]))
                    trace.note(num_consistent_anchors=averaged[1])
        if not hypotheses:
            return Solution(trace.lost(refusal, "no hypothesis of the pose"))

        with trace.stage("refinement"):
            _, generator, hypothesis = max(hypotheses, key=lambda hypothesis: hypothesis[0])
            latent, refined = self.refine(query, hypothesis)
        trace.note(generator=generator, num_points=len(latent.point))
        if refined is None:
            detail = "the latent points do not determine a pose"
            return Solution(trace.lost(Reason.FEW_INLIERS, detail))

        with trace.stage("verdict"):
            evidence = gather_evidence(query, num_candidates, latent, refined, options)
            confidence = measure_confidence(evidence)
            trace.note(
                num_inliers=evidence.num_inliers,
                num_rivals=evidence.num_rivals,
                anchor_inliers=count_by_anchor(query, latent, refined.inliers),
                spread_px=evidence.spread_px,
                depth=evidence.depth,
                confidence=confidence,
                std_ratio=evidence.std_ratio,
            )
            covariance = calibrate_covariance(
                refined.covariance,
                mean_distance(query, latent, refined.cam_from_world),
                self.reader.pose_noise or UNMEASURED,
                options,
            )
            objection = judge(evidence, confidence, covariance, options)
            rests_on = find_support(query, latent, refined)
        if objection is not None:
            reason, detail = objection
            return Solution(Lost(reason, trace.statistics, detail, rests_on))
        is_certain = (
            confidence >= options.enough_confidence
            and evidence.std_ratio < options.enough_position_std_ratio
        )
        localized = Localized(refined.cam_from_world, covariance, trace.statistics, rests_on)
        return Solution(localized, is_certain, refined, latent, MAX_DEPTHS * evidence.depth)


def _round_size(num_taken: int, num_waiting: int, first: int) -> int:
    """Return how many anchors are next; a last round smaller than the first joins that before."""
    size = first if num_taken == 0 else (GROWTH - 1) * num_taken
    return num_waiting if size + first > num_waiting else size


class _Deadline:
    """When an answer is due."""

    def __init__(self, clock: Callable[[], float] | None, max_latency_ms: float | None) -> None:
        self._clock = clock if max_latency_ms is not None else None
        if self._clock is not None:
            self._end = self._clock() + (max_latency_ms or 0.0) / 1e3

    def is_over(self) -> bool:
        return self._clock is not None and self._clock() > self._end

    def start_round(self) -> None:
        if self._clock is not None:
            self._start = self._clock()

    def leaves_no_time(self, growth: float) -> bool:
        """Say whether a round that takes `growth` times as long as the last one would be late."""
        if self._clock is None:
            return False
        now = self._clock()
        return now + growth * (now - self._start) > self._end


class _Trace:
    """What is known of a localization so far."""

    def __init__(self, clock: Callable[[], float] | None, statistics: Statistics) -> None:
        self.clock = clock
        self.statistics = statistics

    def note(self, **values: Any) -> None:
        self.statistics = replace(self.statistics, **values)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = self.clock() if self.clock else 0.0
        yield
        if self.clock:
            spent = self.statistics.stage_ms
            spent[name] = spent.get(name, 0.0) + (self.clock() - start) * 1e3

    def lost(self, reason: Reason, detail: str) -> Lost:
        return Lost(reason, self.statistics, detail)
