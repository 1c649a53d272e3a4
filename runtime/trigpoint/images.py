"""Image files as the localizer takes them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import SourceError


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read an image file as gray levels (H, W), as it lies in the file (no EXIF rotation)."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        raise SourceError(f"{path} is not an image that can be decoded")
    return np.asarray(image, np.uint8)
