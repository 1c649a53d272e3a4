"""The midpoint of two anchors' rays.

Zhou, Sattler, Pollefeys and Leal-Taixe, "To Learn or Not to Learn: Visual Localization from
Essential Matrices", ICRA 2020: the pose, of those that pairs of anchors propose, that most relative
poses agree with.
"""

from __future__ import annotations

from trigpoint.frame import Reason
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import agree_on_pose
from trigpoint_db.methods.matched import Matched, estimate_each_relative_pose


def estimate_pose(matched: Matched, options: LocalizerOptions) -> Rigid3 | Reason:
    """Return the best pair's pose: the midpoint between its rays, the mean of its rotations."""
    query = matched.query
    chosen, query_from_anchors = estimate_each_relative_pose(matched, options)
    consensus = agree_on_pose(query.views[chosen], query_from_anchors, options)
    if isinstance(consensus, Reason):
        return consensus
    return Rigid3.from_center(consensus.R, consensus.center)
