"""A V4L2 capture device: set up, mapped into memory, and its frames taken one by one.

OpenCV tells neither sequence numbers nor which frames are damaged, and linuxpy is GPL.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import mmap
import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from trigpoint.errors import ConfigError
from trigpointd.sources import videodev2 as v4l2

_NUM_BUFFERS = 4


@dataclass(frozen=True)
class VideoFormat:
    """What a device delivers; `step` is the bytes a row, `fps` None where the driver tells none."""

    pixel_format: str
    width: int
    height: int
    step: int
    fps: float | None

    def __str__(self) -> str:
        rate = "" if self.fps is None else f" at {self.fps:g} fps"
        return f"{self.pixel_format}, {self.width} x {self.height} px{rate}"


@dataclass(frozen=True, eq=False)
class RawFrame:
    """A buffer as the driver filled it.

    `monotonic_ns` is the driver's time stamp on CLOCK_MONOTONIC, None where it is of no known
    clock; `damaged` is the driver's own verdict.
    """

    data: bytes
    sequence: int
    monotonic_ns: int | None
    damaged: bool


class Kernel(Protocol):
    """The four system calls that a device is driven by; each raises an OSError."""

    def open(self, path: Path) -> int:
        """Open a device for non-blocking use and return its file descriptor."""
        ...

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Call the driver, which may change the argument."""
        ...

    def mmap(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """Map a buffer of the driver."""
        ...

    def close(self, fd: int) -> None:
        """Close the device."""
        ...


class Linux:
    """The real ones."""

    def open(self, path: Path) -> int:
        """Open a device for non-blocking use and return its file descriptor."""
        return os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Call the driver, which may change the argument."""
        fcntl.ioctl(fd, request, argument)

    def mmap(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """Map a buffer of the driver."""
        return mmap.mmap(fd, length, offset=offset)

    def close(self, fd: int) -> None:
        """Close the device."""
        os.close(fd)


class VideoDevice:
    """An open device; to be used by one thread at a time, and as a context manager.

    What the kernel refuses is an OSError; a device that is no camera, or none that can be used, a
    ConfigError.
    """

    def __init__(self, path: Path, kernel: Kernel) -> None:
        self._kernel = kernel
        self._buffers: list[mmap.mmap] = []
        self._fd = kernel.open(path)
        try:
            self.card = self._query()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the descriptor, which polls as readable when a frame or an error waits."""
        return self._fd

    def configure(
        self, pixel_format: str, width: int, height: int, fps: float | None
    ) -> VideoFormat:
        """Ask for a format and return the one that the driver set, which may be another."""
        wanted = v4l2.Format(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        pix = wanted.fmt.pix
        pix.width, pix.height, pix.field = width, height, v4l2.FIELD_NONE
        pix.pixelformat = v4l2.fourcc(pixel_format)
        self._call(v4l2.VIDIOC_S_FMT, wanted)
        if pix.field != v4l2.FIELD_NONE:
            raise ConfigError("it gives interlaced pictures; choose a progressive input")
        return VideoFormat(
            v4l2.fourcc_name(pix.pixelformat),
            pix.width,
            pix.height,
            pix.bytesperline,
            self._set_rate(fps),
        )

    def control(self, number: int) -> v4l2.QueryControl | None:
        """Return what a control takes, None where the device has none that can be set."""
        control = v4l2.QueryControl(id=number)
        try:
            self._call(v4l2.VIDIOC_QUERYCTRL, control)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                return None
            raise
        fixed = control.flags & (v4l2.CTRL_FLAG_DISABLED | v4l2.CTRL_FLAG_READ_ONLY)
        return None if fixed else control

    def set_control(self, number: int, value: int) -> None:
        """Set a control."""
        self._call(v4l2.VIDIOC_S_CTRL, v4l2.Control(number, value))

    def start(self) -> None:
        """Map buffers, give them to the driver and let frames come."""
        request = v4l2.RequestBuffers(
            count=_NUM_BUFFERS, type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP
        )
        self._call(v4l2.VIDIOC_REQBUFS, request)
        for index in range(request.count):
            buffer = _buffer(index)
            self._call(v4l2.VIDIOC_QUERYBUF, buffer)
            self._buffers.append(self._kernel.mmap(self._fd, buffer.length, buffer.m.offset))
            self._call(v4l2.VIDIOC_QBUF, buffer)
        self._call(v4l2.VIDIOC_STREAMON, ctypes.c_int(v4l2.BUF_TYPE_VIDEO_CAPTURE))

    def dequeue(self) -> RawFrame | None:
        """Take the oldest frame, None where there is none yet."""
        buffer = _buffer(0)
        try:
            self._call(v4l2.VIDIOC_DQBUF, buffer)
        except (BlockingIOError, InterruptedError):
            return None
        data = self._buffers[buffer.index][: buffer.bytesused]
        clock = buffer.flags & v4l2.BUF_FLAG_TIMESTAMP_MASK
        stamp = buffer.timestamp
        frame = RawFrame(
            data,
            buffer.sequence,
            stamp.tv_sec * 10**9 + stamp.tv_usec * 1000
            if clock == v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC
            else None,
            bool(buffer.flags & v4l2.BUF_FLAG_ERROR),
        )
        self._call(v4l2.VIDIOC_QBUF, buffer)
        return frame

    def close(self) -> None:
        """Stop the stream and let go of the device, also of one that is gone."""
        with contextlib.suppress(OSError):
            self._call(v4l2.VIDIOC_STREAMOFF, ctypes.c_int(v4l2.BUF_TYPE_VIDEO_CAPTURE))
        for memory in self._buffers:  # each holds the device open
            memory.close()
        self._kernel.close(self._fd)

    def _query(self) -> str:
        about = v4l2.Capability()
        try:
            self._call(v4l2.VIDIOC_QUERYCAP, about)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):
                raise ConfigError(
                    "it is not a video device; name one such as /dev/video0"
                ) from None
            raise
        has_own = about.capabilities & v4l2.CAP_DEVICE_CAPS
        can = about.device_caps if has_own else about.capabilities
        if not (can & v4l2.CAP_VIDEO_CAPTURE and can & v4l2.CAP_STREAMING):
            raise ConfigError(
                "it is a video device but not a camera that streams by the single-planar API; "
                "`v4l2-ctl --list-devices` lists the others"
            )
        return f"{about.card.decode(errors='replace')} ({about.driver.decode(errors='replace')})"

    def _set_rate(self, fps: float | None) -> float | None:
        parameters = v4l2.StreamParm(type=v4l2.BUF_TYPE_VIDEO_CAPTURE)
        capture = parameters.parm.capture
        try:
            self._call(v4l2.VIDIOC_G_PARM, parameters)
            if fps is not None and capture.capability & v4l2.CAP_TIMEPERFRAME:
                capture.timeperframe = v4l2.Fraction(1000, round(fps * 1000))
                self._call(v4l2.VIDIOC_S_PARM, parameters)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EINVAL):  # it has no rate to set
                return None
            raise
        period = capture.timeperframe
        return period.denominator / period.numerator if period.numerator else None

    def _call(self, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        self._kernel.ioctl(self._fd, request, argument)


def _buffer(index: int) -> v4l2.Buffer:
    return v4l2.Buffer(index=index, type=v4l2.BUF_TYPE_VIDEO_CAPTURE, memory=v4l2.MEMORY_MMAP)
