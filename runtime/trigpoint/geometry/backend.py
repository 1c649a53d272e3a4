"""Which RANSAC solves for poses: PoseLib where it is installed, else OpenCV.

PoseLib is the better and faster one, but has no wheels for aarch64.
"""

from __future__ import annotations

from enum import Enum

try:
    import poselib
except ImportError:
    poselib = None

__all__ = ["NORMALIZED_CAMERA", "Backend", "poselib"]

# PoseLib's description of the camera of normalised image points.
NORMALIZED_CAMERA = {
    "model": "SIMPLE_PINHOLE",
    "width": 1,
    "height": 1,
    "params": [1.0, 0.0, 0.0],
}


class Backend(Enum):
    """Which RANSAC to run."""

    POSELIB = "poselib"
    OPENCV = "opencv"

    @classmethod
    def best(cls) -> Backend:
        """Return the best one installed."""
        return cls.OPENCV if poselib is None else cls.POSELIB
