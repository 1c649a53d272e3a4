"""Localize images of a map against the rest of it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from trigpoint.frame import Anchor
from trigpoint.localizer import Localizer, Solution
from trigpoint.rigid import Rigid3
from trigpoint.stages import Query, match_anchors


@dataclass(frozen=True, eq=False)
class HeldOut:
    """An image of the map that was localized as if it were not there.

    Parameters
    ----------
    image : Anchor
        As the map has it.
    anchors : list of Anchor
        Those that it was localized against (K,).
    query : Query
        Its matches with them.
    solution : Solution
        What came of these.
    """

    image: Anchor
    anchors: list[Anchor]
    query: Query
    solution: Solution

    @property
    def truth(self) -> Rigid3:
        """Its own pose, cam_from_world."""
        return self.image.cam_from_world


def localize_without(localizer: Localizer, index: int, left_out: Collection[int]) -> HeldOut | None:
    """Localize an image of the map with some images left out, itself among them.

    None where fewer than two others are found.
    """
    reader, options = localizer.reader, localizer.options
    features, image = reader.features(index), reader.anchor(index)
    found, _ = reader.search(
        features.global_descriptor, options.num_anchors + len(left_out), options.anchor_diversity
    )
    others = found[~np.isin(found, list(left_out))][: options.num_anchors]
    if len(others) < 2:
        return None
    anchors = [reader.anchor(other) for other in others.tolist()]
    query = match_anchors(
        image.camera, features, anchors, localizer.matcher, localizer.model.long_side_px
    )
    return HeldOut(image, anchors, query, localizer.solve(query))
