"""Image files as the localizer takes them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import SourceError

_PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
_JPEG = b"\xff\xd8"
_NO_FRAME_HEADERS = (0xC4, 0xC8, 0xCC)  # among the markers of JPEG's frame headers
_JPEG_SCAN = b"\xff\xda"
_MAX_SCANS = 100


def read_size(data: bytes) -> tuple[int, int]:
    """Return the width and height in px that a JPEG or PNG file gives, decoding nothing.

    For images of strangers: a few kilobytes can hold an image that fills the memory, or, as a JPEG
    of very many scans, keeps the decoder busy for hours; the latter is an error here.
    """
    try:
        if data.startswith(_PNG):
            width, height = struct.unpack_from(">II", data, len(_PNG))
            return width, height
        offset = len(_JPEG)
        while data.startswith(_JPEG) and data[offset] == 0xFF:
            marker, length = struct.unpack_from(">BH", data, offset + 1)
            if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME_HEADERS:
                height, width = struct.unpack_from(">HH", data, offset + 5)
                if (num_scans := data.count(_JPEG_SCAN, offset)) > _MAX_SCANS:
                    raise SourceError(
                        f"the JPEG has {num_scans} scans; at most {_MAX_SCANS} are decoded"
                    )
                return width, height
            offset += 2 + length
    except (struct.error, IndexError):
        pass
    raise SourceError(f"the image of {len(data)} bytes is no JPEG or PNG, or is cut short")


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
