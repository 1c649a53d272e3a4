"""From gray levels to what a network takes."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.models.contract import ImageContract

Array32 = NDArray[np.float32]

# Of the colours of ImageNet's images, on a scale of 0 to 1.
_IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)[:, None, None]
_IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)[:, None, None]


def resize(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Scale an image, axis by axis."""
    if (height, width) == image.shape:
        return image
    smaller = height < image.shape[0] or width < image.shape[1]
    interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation), np.uint8)


def to_tensor(image: NDArray[np.uint8], contract: ImageContract) -> Array32:
    """Normalise an image (H, W) as a network wants it: (1, C, H, W)."""
    values: Array32 = image.astype(np.float32)[None]
    if contract.normalization == "standardize":
        values = _standardize(image, values)
    elif contract.normalization != "raw":
        values /= np.float32(255)
    if contract.channels == 3:
        values = np.repeat(values, 3, axis=0)
    if contract.normalization == "imagenet":
        values = (values - _IMAGENET_MEAN) / _IMAGENET_STD
    return values[None]


def _standardize(image: NDArray[np.uint8], values: Array32) -> Array32:
    mean, std = cv2.meanStdDev(image)
    standard = (values - np.float32(mean[0, 0])) / np.float32(max(std[0, 0], 4.0))
    return np.clip(standard, -4, 4, out=standard)


def normalize(vectors: Array32) -> Array32:
    """Scale vectors (..., D) to unit length; zero stays zero."""
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Array32 = vectors / np.maximum(norms, np.float32(1e-9))
    return unit
