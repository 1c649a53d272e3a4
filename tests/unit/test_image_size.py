"""The size in an image's header is what the decoder makes of it, or there is none."""

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trigpoint.errors import SourceError
from trigpoint.images import decode_gray, read_size


def encode(suffix: str, width: int, height: int, *options: int) -> bytes:
    image = np.random.default_rng(0).integers(0, 255, (height, width), dtype=np.uint8)
    return cv2.imencode(suffix, image, options)[1].tobytes()


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@given(width=st.integers(1, 300), height=st.integers(1, 300))
def test_the_size_is_read_without_decoding(suffix: str, width: int, height: int) -> None:
    assert read_size(encode(suffix, width, height)) == (width, height)


def test_progressive_jpeg_has_a_size_too() -> None:
    assert read_size(encode(".jpg", 33, 21, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)) == (33, 21)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@given(data=st.data())
def test_whatever_happens_to_a_file_the_size_is_that_of_the_pixels(
    suffix: str, data: st.DataObject
) -> None:
    file = bytearray(encode(suffix, 40, 30))
    for _ in range(data.draw(st.integers(1, 4))):
        file[data.draw(st.integers(0, len(file) - 1))] = data.draw(st.integers(0, 255))
    damaged = bytes(file[: data.draw(st.integers(0, len(file)))])
    try:
        size = read_size(damaged)
        if max(size) > 1000:
            return  # damaged to a size that nobody would decode
        height, width = decode_gray(damaged).shape
    except SourceError:
        return
    assert (width, height) == size


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"\xff\xd8\xff", b"\x89PNG", b"RIFFxxxxWEBP"])
def test_what_is_no_image_is_an_error(data: bytes) -> None:
    with pytest.raises(SourceError, match="no JPEG or PNG, or is cut short"):
        read_size(data)


def test_a_jpeg_of_very_many_scans_is_refused_before_it_is_decoded() -> None:
    file = encode(".jpg", 64, 64, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    start = file.rindex(b"\xff\xda")
    (length,) = struct.unpack_from(">H", file, start + 2)
    scan = file[start : start + 2 + length] + b"\0"
    with pytest.raises(SourceError, match=r"has \d+ scans; at most 100"):
        read_size(file[:start] + 200 * scan + file[start:])
