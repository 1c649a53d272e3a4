"""RootSIFT (Arandjelovic and Zisserman, CVPR 2012): what a network has to beat."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.frame import LocalFeatures


class RootSift:
    """OpenCV's SIFT with Hellinger-normalised descriptors."""

    def extract(self, image: NDArray[np.uint8], max_keypoints: int = 1024) -> LocalFeatures:
        """Extract at most `max_keypoints` features of a gray image (H, W), best score first."""
        keypoints, descriptors = _sift(max_keypoints).detectAndCompute(image, None)
        scores = np.array([keypoint.response for keypoint in keypoints], np.float32)
        best = np.argsort(-scores, kind="stable")[:max_keypoints]
        points = np.array([keypoint.pt for keypoint in keypoints], np.float32).reshape(-1, 2)
        if descriptors is None:
            descriptors = np.empty((0, 128), np.float32)
        sums = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
        roots = np.sqrt(descriptors / sums).astype(np.float32)
        none = np.empty(0, np.float32)
        return LocalFeatures(points[best], roots[best], scores[best], none)


@functools.cache
def _sift(max_keypoints: int) -> cv2.SIFT:
    return cv2.SIFT_create(max_keypoints)
