"""Relative-pose averaging: stage 1 of the paper, and no more."""

from __future__ import annotations

from trigpoint.frame import Reason
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import average_poses, estimate_relative_poses
from trigpoint_db.methods.matched import Matched


def estimate_pose(matched: Matched, options: LocalizerOptions) -> Rigid3 | Reason:
    """Average the centers and rotations of the anchors that agree (paper, section III)."""
    query = matched.query
    chosen, query_from_anchors = estimate_relative_poses(query, options)
    averaged = average_poses(query.views[chosen], query_from_anchors, options)
    return averaged if isinstance(averaged, Reason) else averaged[0]
