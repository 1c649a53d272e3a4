"""Frame in, pose out: the paper's pipeline, top to bottom.

A pure function of the frame, the map's snapshot and the options; the clock is the caller's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trigpoint.frame import (
    Anchor,
    Frame,
    LocalFeatures,
    Localized,
    Lost,
    Reason,
    Result,
    Statistics,
)
from trigpoint.geometry.absolute_pose import estimate_absolute_pose
from trigpoint.geometry.epipolar import essential_matrix, sampson_error
from trigpoint.geometry.pose_refinement import RefinedPose, refine_pose, reprojection
from trigpoint.geometry.triangulation import LatentPoints, Tracks, triangulate_robust
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import match_mutual
from trigpoint.rigid import Rigid3

Array = NDArray[np.float64]


class Map(Protocol):
    """What the localizer asks of a map."""

    def __len__(self) -> int: ...

    def search(
        self, global_descriptor: NDArray[np.float32], k: int
    ) -> tuple[NDArray[np.intp], NDArray[np.float32]]: ...

    def anchor(self, index: int) -> Anchor: ...


@dataclass(frozen=True)
class LocalizerOptions:
    num_anchors: int = 20
    max_keypoints: int = 1024
    num_relative_poses: int = 8
    max_epipolar_error_px: float = 2.0
    max_ray_error_px: float = 3.0
    max_reprojection_error_px: float = 4.0
    sigma_px: float = 1.0
    rounds: int = 2
