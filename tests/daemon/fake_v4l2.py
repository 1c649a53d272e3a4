"""A camera's driver that does what a test tells it to, beneath the real source."""

from __future__ import annotations

import ctypes
import dataclasses
import errno
import mmap
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from trigpointd.sources import videodev2 as v4l2

MONOTONIC = v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC


@dataclass(frozen=True)
class Filled:
    """A buffer that the driver filled; without a stamp, at the moment that it is fetched."""

    data: bytes
    sequence: int = 0
    monotonic_ns: int | None = None
    flags: int = MONOTONIC


@dataclass
class Knob:
    """A control of a camera; it may be read-only, or refuse what is set with an error."""

    minimum: int
    maximum: int
    default: int
    flags: int = 0
    error: OSError | None = None
    value: int | None = None  # as it was set


@dataclass
class Plugged:
    """A camera that is there: what it is, and what comes of its stream before it is silent.

    An OSError in the stream is what the driver answers from then on.
    """

    stream: Sequence[Filled | OSError] = ()
    pixel_format: str = "YUYV"
    width: int = 8
    height: int = 4
    padding: int = 0  # of each row, in bytes
    field: int = v4l2.FIELD_NONE
    fps: int | None = 30
    capabilities: int = v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_STREAMING
    controls: Mapping[int, Knob] = dataclasses.field(default_factory=dict)

    @property
    def step(self) -> int:
        depth = {"YUYV": 2, "GREY": 1, "NV12": 1}.get(self.pixel_format)
        return 0 if depth is None else self.width * depth + self.padding


class FakeKernel:
    """Gives each opening what is planned for it: a camera, or an error; after that, no camera.

    As a real driver it fills only buffers that are queued, takes only calls that are due, and its
    descriptor polls as readable while something waits.
    """

    def __init__(self, *plan: Plugged | OSError) -> None:
        self._plan = list(plan)
        self.num_opened = 0
        self.asked = threading.Event()  # for the camera
        self.streaming = threading.Event()
        self.open_descriptors: set[int] = set()
        self.requests: list[tuple[str, int, int]] = []
        self.rates: list[float] = []

    def open(self, path: Path) -> int:
        self.num_opened += 1
        self.asked.set()
        planned = self._plan.pop(0) if self._plan else OSError(errno.ENOENT, "No such file")
        if isinstance(planned, OSError):
            raise planned
        assert not self.open_descriptors, "the camera is open already"
        self._camera = planned
        self._stream = list(planned.stream)
        self._memory: list[mmap.mmap] = []
        self._queued: list[int] = []
        fd = os.eventfd(0, os.EFD_NONBLOCK)
        self.open_descriptors.add(fd)
        return fd

    def close(self, fd: int) -> None:
        assert all(memory.closed for memory in self._memory), "a mapping holds the device"
        self.open_descriptors.remove(fd)
        self.streaming.clear()
        os.close(fd)

    def mmap(self, fd: int, length: int, offset: int) -> mmap.mmap:
        assert (fd in self.open_descriptors, length) == (True, self._length)
        assert offset == len(self._memory) * mmap.PAGESIZE
        self._memory.append(mmap.mmap(-1, length))
        return self._memory[-1]

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        assert fd in self.open_descriptors
        if isinstance(argument, v4l2.Capability):
            assert request == v4l2.VIDIOC_QUERYCAP
            argument.card, argument.driver = b"Fake Camera", b"fake"
            argument.capabilities = self._camera.capabilities | v4l2.CAP_DEVICE_CAPS
            argument.device_caps = self._camera.capabilities
        elif isinstance(argument, v4l2.Format):
            assert request == v4l2.VIDIOC_S_FMT
            self._set_format(argument.fmt.pix)
        elif isinstance(argument, v4l2.StreamParm):
            self._set_rate(request, argument.parm.capture)
        elif isinstance(argument, v4l2.QueryControl | v4l2.Control):
            self._handle_control(request, argument)
        elif isinstance(argument, v4l2.RequestBuffers):
            assert request == v4l2.VIDIOC_REQBUFS
            argument.count = min(argument.count, 3)
        elif isinstance(argument, v4l2.Buffer):
            self._handle_buffer(fd, request, argument)
        elif request == v4l2.VIDIOC_STREAMON:
            self.streaming.set()
            self._signal(fd)
        else:
            assert request == v4l2.VIDIOC_STREAMOFF

    def _set_format(self, pix: v4l2.PixFormat) -> None:
        camera = self._camera
        self.requests.append((v4l2.fourcc_name(pix.pixelformat), pix.width, pix.height))
        pix.width, pix.height, pix.field = camera.width, camera.height, camera.field
        pix.pixelformat = v4l2.fourcc(camera.pixel_format)
        pix.bytesperline = camera.step

    def _set_rate(self, request: int, capture: v4l2.CaptureParm) -> None:
        if self._camera.fps is None:
            raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")
        if request == v4l2.VIDIOC_S_PARM:
            self.rates.append(capture.timeperframe.denominator / capture.timeperframe.numerator)
        capture.capability = v4l2.CAP_TIMEPERFRAME
        capture.timeperframe = v4l2.Fraction(1, self._camera.fps)

    def _handle_control(self, request: int, argument: v4l2.QueryControl | v4l2.Control) -> None:
        knob = self._camera.controls.get(argument.id)
        if knob is None:
            raise OSError(errno.EINVAL, "Invalid argument")
        if isinstance(argument, v4l2.QueryControl):
            assert request == v4l2.VIDIOC_QUERYCTRL
            argument.minimum, argument.maximum = knob.minimum, knob.maximum
            argument.default_value, argument.flags = knob.default, knob.flags
            return
        assert request == v4l2.VIDIOC_S_CTRL
        assert not knob.flags & v4l2.CTRL_FLAG_READ_ONLY
        if knob.error is not None:
            raise knob.error
        assert knob.minimum <= argument.value <= knob.maximum
        knob.value = argument.value

    @property
    def _length(self) -> int:
        frames = [item for item in self._camera.stream if isinstance(item, Filled)]
        return max([len(frame.data) for frame in frames], default=0) + 64

    def _handle_buffer(self, fd: int, request: int, buffer: v4l2.Buffer) -> None:
        assert (buffer.type, buffer.memory) == (v4l2.BUF_TYPE_VIDEO_CAPTURE, v4l2.MEMORY_MMAP)
        if request == v4l2.VIDIOC_QUERYBUF:
            buffer.length, buffer.m.offset = self._length, buffer.index * mmap.PAGESIZE
        elif request == v4l2.VIDIOC_QBUF:
            assert buffer.index not in self._queued
            self._queued.append(buffer.index)
        else:
            assert (request, self.streaming.is_set()) == (v4l2.VIDIOC_DQBUF, True)
            self._dequeue(fd, buffer)

    def _dequeue(self, fd: int, buffer: v4l2.Buffer) -> None:
        if not self._stream:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        if isinstance(self._stream[0], OSError):
            raise self._stream[0]
        filled = self._stream.pop(0)
        assert isinstance(filled, Filled)
        buffer.index = self._queued.pop(0)
        self._memory[buffer.index][: len(filled.data)] = filled.data
        buffer.bytesused, buffer.sequence = len(filled.data), filled.sequence
        stamp_ns = time.monotonic_ns() if filled.monotonic_ns is None else filled.monotonic_ns
        buffer.timestamp.tv_sec, rest_ns = divmod(stamp_ns, 10**9)
        buffer.timestamp.tv_usec, buffer.flags = rest_ns // 1000, filled.flags
        self._signal(fd)

    def _signal(self, fd: int) -> None:
        """Let the descriptor poll as readable, or not."""
        os.eventfd_write(fd, 1)
        if not self._stream:
            os.eventfd_read(fd)
