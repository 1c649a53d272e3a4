"""trigpointd before a camera that plays a film: python -m benchmarks.daemon.film run --config FILE.

`source.device` of the settings is a folder with a file for each frame, in `source.format`. All
above the system calls on the device is the daemon as it is. While there is no such folder, the
camera is unplugged.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import time
from collections import deque
from pathlib import Path

from trigpointd import cli
from trigpointd.sources import v4l2, videodev2

_DEFAULT_FPS = 30
_MAX_WAITING = 4
_NS = 10**9
_libc = ctypes.CDLL(None, use_errno=True)


class _TimerSpec(ctypes.Structure):
    """struct itimerspec."""

    _fields_ = (
        ("interval_s", ctypes.c_long),
        ("interval_ns", ctypes.c_long),
        ("value_s", ctypes.c_long),
        ("value_ns", ctypes.c_long),
    )


class FilmKernel:
    """Drives the film as Linux drives a camera: see `trigpointd.sources.video_device.Kernel`.

    Each buffer holds a frame of the film from the start. They come at an even pace, there and back,
    stamped with the moment at which they are due; what comes while `_MAX_WAITING` wait is lost, but
    its number counts. The descriptor is that of a timer: it can be read as soon as a frame is
    there, without any thread.
    """

    def __init__(self) -> None:
        self._period_ns = _NS // _DEFAULT_FPS

    def open(self, path: Path) -> int:
        """Find the frames; without them there is no camera."""
        self._folder, self._frames = path, sorted(path.iterdir())
        self._sizes = [frame.stat().st_size for frame in self._frames]
        self._waiting: deque[int] = deque()  # frames, by their numbers
        self._sequence = 0  # of the next one
        return _check(_libc.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC))

    def close(self, fd: int) -> None:
        """Close the timer."""
        os.close(fd)

    def mmap(self, fd: int, length: int, offset: int) -> mmap.mmap:
        """Map a frame."""
        with self._frames[offset // mmap.PAGESIZE].open("rb") as file:
            return mmap.mmap(file.fileno(), length, prot=mmap.PROT_READ)

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        """Do as a driver that can give all that it is asked for."""
        if isinstance(argument, videodev2.Capability):
            argument.card, argument.driver = b"A film", b"film"
            argument.capabilities = videodev2.CAP_VIDEO_CAPTURE | videodev2.CAP_STREAMING
        elif isinstance(argument, videodev2.Format):
            pix = argument.fmt.pix
            pix.bytesperline = 2 * pix.width  # of YUYV; Motion JPEG has no rows
        elif isinstance(argument, videodev2.StreamParm):
            self._set_rate(argument.parm.capture)
        elif isinstance(argument, videodev2.RequestBuffers):
            argument.count = len(self._frames)
        elif request == videodev2.VIDIOC_QUERYBUF and isinstance(argument, videodev2.Buffer):
            argument.length = self._sizes[argument.index]
            argument.m.offset = argument.index * mmap.PAGESIZE
        elif request == videodev2.VIDIOC_DQBUF and isinstance(argument, videodev2.Buffer):
            self._dequeue(fd, argument)
        elif request == videodev2.VIDIOC_STREAMON:
            self._start_ns = time.monotonic_ns()
            self._set_timer(fd)

    def _set_rate(self, capture: videodev2.CaptureParm) -> None:
        period = capture.timeperframe
        if period.denominator:
            self._period_ns = _NS * period.numerator // period.denominator
        capture.capability = videodev2.CAP_TIMEPERFRAME
        capture.timeperframe = videodev2.Fraction(self._period_ns // 1000, 10**6)

    def _dequeue(self, fd: int, buffer: videodev2.Buffer) -> None:
        if not self._folder.exists():
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
        while self._due_ns(self._sequence) <= time.monotonic_ns():
            if len(self._waiting) < _MAX_WAITING:
                self._waiting.append(self._sequence)
            self._sequence += 1
        if not self._waiting:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        buffer.sequence = self._waiting.popleft()
        last = len(self._frames) - 1
        buffer.index = last - abs(last - buffer.sequence % (2 * last))  # there and back
        buffer.bytesused = self._sizes[buffer.index]
        stamp_s, rest_ns = divmod(self._due_ns(buffer.sequence), _NS)
        buffer.timestamp.tv_sec, buffer.timestamp.tv_usec = stamp_s, rest_ns // 1000
        buffer.flags = videodev2.BUF_FLAG_TIMESTAMP_MONOTONIC
        self._set_timer(fd)

    def _due_ns(self, sequence: int) -> int:
        return self._start_ns + (sequence + 1) * self._period_ns

    def _set_timer(self, fd: int) -> None:
        """Let the descriptor be readable from when the next frame is there."""
        sequence = self._waiting[0] if self._waiting else self._sequence
        spec = _TimerSpec(0, 0, *divmod(self._due_ns(sequence), _NS))
        _check(_libc.timerfd_settime(fd, 1, ctypes.byref(spec), None))  # 1: an absolute time


def _check(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def main() -> None:
    """Be trigpointd."""
    v4l2.Linux = FilmKernel  # type: ignore[attr-defined,assignment]
    cli.main()


if __name__ == "__main__":
    main()
