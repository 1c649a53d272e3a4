"""Frame in, pose out: the paper's pipeline, top to bottom.

A pure function of the frame, the map's snapshot and the options. It has no clock of its own: stage
times are measured with the caller's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from trigpoint.database.reader import MapReader
from trigpoint.frame import Frame, Localized, Lost, Reason, Result, Statistics
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import Matcher, MutualNearestNeighbors
from trigpoint.rigid import Rigid3
from trigpoint.stages import (
    UNMEASURED,
    LocalizerOptions,
    average_poses,
    calibrate_covariance,
    count_support,
    estimate_relative_poses,
    extract_turned,
    find_latent_points,
    judge,
    match_anchors,
    mean_distance,
    refine,
    refine_with_anchors,
    solve_latent_points,
)

MIN_CONTRAST = 2.0  # standard deviation of the gray levels


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
        Seconds, monotonic; without it the results have no stage times.
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

    def localize(self, frame: Frame) -> Result:
        """Estimate cam_from_world of a frame, with covariance, or say why not.

        With `try_turned`, a frame that is lost as it is is also tried on its sides and upside down.
        """
        result = self._localize(frame, Statistics())
        if isinstance(result, Localized) or not self.options.try_turned:
            return result
        if result.reason in (Reason.NO_MAP, Reason.TOO_DARK, Reason.FEW_FEATURES):
            return result
        for turned_deg in (90, 180, 270):
            start = Statistics(turned_deg=turned_deg, stage_ms=result.statistics.stage_ms)
            turned = self._localize(frame, start)
            if isinstance(turned, Localized):
                return turned
        return result

    def _localize(self, frame: Frame, statistics: Statistics) -> Result:
        options, trace = self.options, _Trace(self.clock, statistics)
        if len(self.reader) == 0:
            return trace.lost(Reason.NO_MAP, "the map holds no image")
        if (contrast := float(frame.image.std())) < MIN_CONTRAST:
            return trace.lost(Reason.TOO_DARK, f"contrast {contrast:.1f} gray levels")

        with trace.stage("features"):
            features = extract_turned(
                self.model, frame.image, options.max_keypoints, statistics.turned_deg
            )
        trace.note(num_features=len(features))
        if len(features) < options.min_features:
            return trace.lost(Reason.FEW_FEATURES, f"{len(features)} keypoints")

        with trace.stage("retrieval"):
            indices, _ = self.reader.search(
                features.global_descriptor, options.num_anchors, options.anchor_diversity
            )
            anchors = [self.reader.anchor(int(index)) for index in indices]
        trace.note(num_anchors=len(anchors), anchors=tuple(anchor.name for anchor in anchors))

        if len(anchors) < 2:
            return trace.lost(Reason.FEW_ANCHORS, "the map holds a single image")

        with trace.stage("matching"):
            query = match_anchors(
                frame.camera, features, anchors, self.matcher, self.model.long_side_px
            )
        trace.note(num_matches=len(query.tracks), num_matcher_failures=query.num_matcher_failures)

        with trace.stage("latent_points"):
            latent = find_latent_points(query, options)
        trace.note(num_points=len(latent.point))
        if len(latent.point) < options.min_inliers:
            return trace.lost(Reason.FEW_MATCHES, f"{len(latent.point)} points in two anchors")

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
            return trace.lost(refusal, "no hypothesis of the pose")

        with trace.stage("refinement"):
            _, generator, hypothesis = max(hypotheses, key=lambda hypothesis: hypothesis[0])
            latent, refined = refine(query, hypothesis, options)
            if refined is not None:
                refined = refine_with_anchors(query, latent, refined.cam_from_world, options)
        trace.note(generator=generator, num_points=len(latent.point))
        if refined is None:
            return trace.lost(Reason.FEW_INLIERS, "the latent points do not determine a pose")
        trace.note(num_inliers=int(refined.inliers.sum()))
        distance = mean_distance(query, latent, refined.cam_from_world)
        map_noise = self.reader.pose_noise or UNMEASURED
        covariance = calibrate_covariance(refined.covariance, distance, map_noise, options)
        refined = replace(refined, covariance=covariance)
        objection = judge(latent, refined, options)
        if objection is not None:
            return trace.lost(*objection)
        return Localized(refined.cam_from_world, refined.covariance, trace.statistics)


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
