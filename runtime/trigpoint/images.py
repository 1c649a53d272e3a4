"""Image files as the localizer takes them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import SourceError


def decode_gray(data: bytes) -> NDArray[np.uint8]:
    """Decode an image file's bytes to gray levels (H, W).

    A calibration belongs to the sensor's rows: an EXIF orientation must not turn them.
    """
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error as error:
        raise SourceError(f"the image cannot be decoded: {error.err}") from error
    if image is None:
        raise SourceError(
            f"the image of {len(data)} bytes is broken, cut short or in a format other than JPEG, "
            "PNG or WebP"
        )
    return image.astype(np.uint8, copy=False)


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read an image file as gray levels (H, W)."""
    try:
        return decode_gray(path.read_bytes())
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from error
