"""Retrieval alone: the pose of the image that looks most alike."""

from __future__ import annotations

from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint_db.methods.matched import Matched


def estimate_pose(matched: Matched, _: LocalizerOptions) -> Rigid3:
    """Return the first anchor's pose."""
    return matched.query.views[0]
