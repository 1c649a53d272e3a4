"""Translation averaging: what the paper's center averaging takes the place of (eq. 5)."""

from __future__ import annotations

from trigpoint.frame import Reason
from trigpoint.geometry.rotation_averaging import average_rotations
from trigpoint.geometry.translation_averaging import average_translations
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import find_consistent
from trigpoint_db.methods.matched import Matched, estimate_each_relative_pose


def estimate_pose(matched: Matched, options: LocalizerOptions) -> Rigid3 | Reason:
    """Average the translations and rotations of the anchors that agree."""
    query = matched.query
    chosen, query_from_anchors = estimate_each_relative_pose(matched, options)
    consistent = find_consistent(query.views[chosen], query_from_anchors, options)
    if isinstance(consistent, Reason):
        return consistent
    anchors, relative = consistent
    translation = average_translations(anchors, relative)
    if translation is None:
        return Reason.DEGENERATE_ANCHORS
    return Rigid3(average_rotations(relative.R @ anchors.R), translation)
