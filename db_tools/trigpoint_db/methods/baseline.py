"""Localize frames with another method than the localizer's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from trigpoint.frame import Frame, Lost, Prior, Reason, Statistics, describe_statistics
from trigpoint.localizer import Localizer
from trigpoint.rigid import Rigid3
from trigpoint_db.methods.matched import Matched, match_frame, timed
from trigpoint_db.methods.registry import MethodName, load_method


@dataclass(frozen=True, eq=False)
class Estimate:
    """A pose that nobody has judged, without covariance.

    Parameters
    ----------
    cam_from_world : Rigid3
    statistics : Statistics
        With the method's name as the generator.
    """

    cam_from_world: Rigid3
    statistics: Statistics

    def describe(self) -> dict[str, Any]:
        """Say it in JSON's types, as a localizer's results are said."""
        return {
            "status": "LOCALIZED",
            "reason": None,
            "center": self.cam_from_world.center.tolist(),
            "rotation_wxyz": self.cam_from_world.inverse().quaternion.tolist(),
            "covariance": None,
            **describe_statistics(self.statistics),
        }


class Baseline:
    """A method, with what a localizer has: network, map, options, matcher, clock.

    Parameters
    ----------
    name : MethodName
        Of a method other than the localizer.
    localizer : Localizer
        Its own stages after the matching are not used, nor its rounds.
    """

    def __init__(self, name: MethodName, localizer: Localizer) -> None:
        self.name = name
        self._method = load_method(name)
        self._localizer = localizer

    def localize(self, frame: Frame, prior: Prior | None = None) -> Estimate | Lost:
        """Estimate cam_from_world of a frame, or say why not."""
        matched = match_frame(self._localizer, frame, prior)
        return matched if isinstance(matched, Lost) else self.solve(matched)

    def solve(self, matched: Matched) -> Estimate | Lost:
        """Solve for the pose of a frame that is matched."""
        stage_ms = dict(matched.statistics.stage_ms)
        with timed(self._localizer, stage_ms, "pose"):
            found = self._method(matched, self._localizer.options)
        statistics = replace(matched.statistics, generator=self.name, stage_ms=stage_ms)
        if isinstance(found, Reason):
            return Lost(found, statistics, f"the method {self.name} finds no pose")
        return Estimate(found, statistics)
