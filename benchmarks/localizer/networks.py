"""The networks that the localizer is measured with."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.models import edgepoint2
from benchmarks.models.surveys import shrink
from trigpoint.frame import LocalFeatures, ModelIdentity
from trigpoint.models.features import FeatureModel
from trigpoint.models.session import hash_files


class EdgePointModel:
    """EdgePoint2-E64's keypoints, refined, and descriptors; the global descriptor is `base`'s.

    It does for maps and the localizer what `FeatureModel` does.
    """

    def __init__(self, checkout: Path, scratch: Path) -> None:
        path = scratch / "E64.onnx"
        # In a process of its own: torch's threads would disturb the clock.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            pool.submit(edgepoint2.export, checkout.resolve(), "E64", path).result()
        self._local = edgepoint2.EdgePoint2(path, subpixel=True)
        self._described = FeatureModel.load("base")
        self.identity = ModelIdentity("EdgePoint2-E64", hash_files(path), 64, 256)
        self.long_side_px = self._described.long_side_px

    def extract(self, image: NDArray[np.uint8], max_keypoints: int = 1024) -> LocalFeatures:
        """Extract features of a gray image (H, W), best score first."""
        small = shrink(image)
        found = self._local.extract(small, max_keypoints)
        zoom = np.divide(image.shape[::-1], small.shape[::-1]).astype(np.float32)
        keypoints = (found.keypoints + 0.5) * zoom - 0.5
        described = self._described.extract(image, 1).global_descriptor
        return LocalFeatures(keypoints, found.descriptors, found.scores, described)

    @classmethod
    def load(cls, checkout: Path, scratch: Path) -> FeatureModel:
        """Export the network of a checkout."""
        return cast("FeatureModel", cls(checkout, scratch))
