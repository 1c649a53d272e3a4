"""Relative-pose averaging: stage 1 of the paper, and no more."""

from __future__ import annotations

from dataclasses import replace

from trigpoint.frame import Reason
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import average_poses
from trigpoint_db.methods.matched import Matched, estimate_each_relative_pose


def estimate_pose(matched: Matched, options: LocalizerOptions) -> Rigid3 | Reason:
    """Average the centers (Proposition 1) and rotations of the anchors that agree."""
    query = matched.query
    chosen, query_from_anchors = estimate_each_relative_pose(matched, options)
    as_published = replace(options, center="least_squares")
    averaged = average_poses(query.views[chosen], query_from_anchors, as_published)
    return averaged if isinstance(averaged, Reason) else averaged[0]
