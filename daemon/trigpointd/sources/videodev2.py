"""What of linux/videodev2.h a camera needs: structures, ioctl numbers, constants.

The numbers are those of the generic encoding, which x86, ARM and RISC-V use.
"""

from __future__ import annotations

import ctypes
from ctypes import c_char, c_int, c_int32, c_long, c_uint8, c_uint32, c_ulong, c_void_p

CAP_VIDEO_CAPTURE = 0x1
CAP_STREAMING = 0x0400_0000
CAP_DEVICE_CAPS = 0x8000_0000
CAP_TIMEPERFRAME = 0x1000

BUF_TYPE_VIDEO_CAPTURE = 1
MEMORY_MMAP = 1
FIELD_NONE = 1  # progressive

BUF_FLAG_ERROR = 0x40
BUF_FLAG_TIMESTAMP_MASK = 0xE000
BUF_FLAG_TIMESTAMP_MONOTONIC = 0x2000

CID_AUTOGAIN = 0x0098_0912
CID_GAIN = 0x0098_0913
CID_EXPOSURE_AUTO = 0x009A_0901
CID_EXPOSURE_ABSOLUTE = 0x009A_0902  # in 0.1 ms
CID_EXPOSURE_AUTO_PRIORITY = 0x009A_0903  # whether the rate may fall for longer exposures
EXPOSURE_MANUAL = 1
CTRL_FLAG_DISABLED = 0x1
CTRL_FLAG_READ_ONLY = 0x4


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixFormat(ctypes.Structure):
    """struct v4l2_pix_format."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class _FormatUnion(ctypes.Union):
    _fields_ = (("pix", PixFormat), ("pointer", c_void_p), ("raw_data", c_uint8 * 200))


class Format(ctypes.Structure):
    """struct v4l2_format."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Fraction(ctypes.Structure):
    """struct v4l2_fract."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class CaptureParm(ctypes.Structure):
    """struct v4l2_captureparm."""

    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _ParmUnion(ctypes.Union):
    _fields_ = (("capture", CaptureParm), ("raw_data", c_uint8 * 200))


class StreamParm(ctypes.Structure):
    """struct v4l2_streamparm."""

    _fields_ = (("type", c_uint32), ("parm", _ParmUnion))


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class Timeval(ctypes.Structure):
    """struct timeval."""

    _fields_ = (("tv_sec", c_long), ("tv_usec", c_long))


class Timecode(ctypes.Structure):
    """struct v4l2_timecode."""

    _fields_ = (
        ("type", c_uint32),
        ("flags", c_uint32),
        ("frames", c_uint8),
        ("seconds", c_uint8),
        ("minutes", c_uint8),
        ("hours", c_uint8),
        ("userbits", c_uint8 * 4),
    )


class _BufferUnion(ctypes.Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_ulong), ("planes", c_void_p), ("fd", c_int32))


class Buffer(ctypes.Structure):
    """struct v4l2_buffer."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", Timeval),
        ("timecode", Timecode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _BufferUnion),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", c_uint32), ("value", c_int32))


_WRITE, _READ = 1, 2


def _ioctl(direction: int, number: int, argument: type[ctypes.Structure | c_int]) -> int:
    return direction << 30 | ctypes.sizeof(argument) << 16 | ord("V") << 8 | number


VIDIOC_QUERYCAP = _ioctl(_READ, 0, Capability)
VIDIOC_S_FMT = _ioctl(_READ | _WRITE, 5, Format)
VIDIOC_REQBUFS = _ioctl(_READ | _WRITE, 8, RequestBuffers)
VIDIOC_QUERYBUF = _ioctl(_READ | _WRITE, 9, Buffer)
VIDIOC_QBUF = _ioctl(_READ | _WRITE, 15, Buffer)
VIDIOC_DQBUF = _ioctl(_READ | _WRITE, 17, Buffer)
VIDIOC_STREAMON = _ioctl(_WRITE, 18, c_int)
VIDIOC_STREAMOFF = _ioctl(_WRITE, 19, c_int)
VIDIOC_G_PARM = _ioctl(_READ | _WRITE, 21, StreamParm)
VIDIOC_S_PARM = _ioctl(_READ | _WRITE, 22, StreamParm)
VIDIOC_S_CTRL = _ioctl(_READ | _WRITE, 28, Control)
VIDIOC_QUERYCTRL = _ioctl(_READ | _WRITE, 36, QueryControl)


def fourcc(name: str) -> int:
    """Return the number of a pixel format of four letters."""
    return int.from_bytes(name.encode(), "little")


def fourcc_name(number: int) -> str:
    """Return the letters of a pixel format's number."""
    return number.to_bytes(4, "little").decode("ascii", "backslashreplace")
