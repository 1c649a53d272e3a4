"""Frames from a V4L2 camera."""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import os
import select
import time
from collections.abc import AsyncGenerator, Generator, Iterator
from functools import partial

import cv2

from trigpoint.camera_messages import Image
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpoint.localizer import MIN_CONTRAST
from trigpointd.clock import WallClock
from trigpointd.config import V4l2Config
from trigpointd.messages.foxglove import calibration_message, gray_image, image_message
from trigpointd.messages.images import parse_calibration, to_frame
from trigpointd.sources.base import BadFrame, Captured
from trigpointd.sources.exposure import set_exposure
from trigpointd.sources.lookahead import read_ahead
from trigpointd.sources.video_device import Kernel, Linux, RawFrame, VideoDevice, VideoFormat

_log = logging.getLogger(__name__)
# The encoding of a raw image; None is a compressed one.
_ENCODINGS = {"YUYV": "yuyv", "GREY": "mono8", "NV12": "nv12", "MJPG": None, "JPEG": None}
_MAX_AGE_NS = 5 * 10**9
_MAX_AHEAD_S = 0.1  # or a frame's period: some drivers stamp with when that ends
_MAX_RATE_ERROR = 0.01
_ABSENT = (errno.ENOENT, errno.ENODEV, errno.ENXIO)
_HINTS = {
    errno.EACCES: "no permission to open it; add the daemon's user to the group `video`",
    errno.EBUSY: "another program uses it; end that one",
    errno.EIO: "input/output error; if it stays, check the cable and the power",
}


class V4l2Source:
    """Reads a camera, which is opened with each stream of frames.

    The camera is opened, read and closed by one thread at a time, in the steps of a generator,
    which waits for frames on a descriptor that wakes it to end.

    Parameters
    ----------
    config : V4l2Config
        The device, its intrinsics and what it is asked for.
    kernel : Kernel, optional
        What the device is driven by.
    """

    def __init__(self, config: V4l2Config, *, kernel: Kernel | None = None) -> None:
        self.name = f"camera {config.device}"
        self._config = config
        self._kernel = kernel or Linux()
        self._clock = WallClock()
        self._calibration = calibration_message(config.camera, time.time_ns())
        # As a replay of the log reads it: an OPENCV camera without distortion becomes a PINHOLE.
        channel, data = self._calibration.channel, self._calibration.data
        self._camera = parse_calibration(
            channel.message_encoding, channel.schema_name, data
        ).camera()
        self._num_missed = 0
        self._described = ""

    def describe(self) -> str:
        """Open the camera and say what it delivers."""
        with self._open() as (device, given):
            return self._describe(device, given)

    async def frames(self) -> AsyncGenerator[Captured, None]:
        """Open the camera and yield frames as it gives them."""
        wake = os.eventfd(0)
        ahead = read_ahead(self._captures(wake), stop=partial(os.eventfd_write, wake, 1))
        try:
            async with contextlib.aclosing(ahead):
                async for captured in ahead:
                    yield captured
        finally:
            os.close(wake)

    async def close(self) -> None:
        """Nothing is held once `frames` has ended."""

    @contextlib.contextmanager
    def _open(self) -> Iterator[tuple[VideoDevice, VideoFormat]]:
        try:
            with VideoDevice(self._config.device, self._kernel) as device:
                yield device, self._configure(device)
        except OSError as error:
            raise SourceError(_explain(error)) from error

    def _captures(self, wake: int) -> Generator[Captured, None, None]:
        with self._open() as (device, given):
            described = self._describe(device, given)
            if described != self._described:
                self._described = described
                _log.info("%s: %s", self.name, described)
            device.start()
            yield from self._stream(device, given, wake)

    def _configure(self, device: VideoDevice) -> VideoFormat:
        """Ask for what is configured; take another format or rate, but no other size."""
        config, camera = self._config, self._camera
        given = device.configure(config.format, camera.width, camera.height, config.fps)
        if (given.width, given.height) != (camera.width, camera.height):
            raise ConfigError(
                f"it gives {given.width} x {given.height} px, but source.camera is for "
                f"{camera.width} x {camera.height} px; give the intrinsics of a size it has"
            )
        if given.pixel_format not in _ENCODINGS:
            raise ConfigError(
                f"it gives {given.pixel_format}, which cannot be read, where {config.format} was "
                "asked for; `v4l2-ctl --list-formats-ext` lists what source.format may be"
            )
        set_exposure(device, config)
        return given

    def _stream(self, device: VideoDevice, given: VideoFormat, wake: int) -> Iterator[Captured]:
        """Yield frames until woken; a camera that gives no usable one for long is lost."""
        checks = _Checks(self._config, given, self._clock)
        timeout_s, usable_s = self._config.timeout_s, time.monotonic()
        problem = "it sends nothing"
        while True:
            left_s = usable_s + timeout_s - time.monotonic()
            ready = _wait(wake, device.fileno(), timeout_s=max(left_s, 0.0))
            if wake in ready:
                return
            raw = device.dequeue() if ready else None
            if raw is not None:
                captured = self._capture(raw, given, checks)
                if isinstance(captured.frame, Frame):
                    yield captured
                    usable_s = time.monotonic()
                    continue
                problem = captured.frame.detail
                yield captured
            if left_s <= 0:
                raise SourceError(f"no usable frame in {timeout_s:g} s: {problem}")

    def _capture(self, raw: RawFrame, given: VideoFormat, checks: _Checks) -> Captured:
        arrival_ns = time.time_ns()
        name = f"{self._config.device.name}#{raw.sequence}"
        self._num_missed += checks.count_missed(raw)
        try:
            time_ns = checks.time_ns(raw)
            encoding = _ENCODINGS[given.pixel_format]
            image = Image(
                time_ns, "camera", raw.data, encoding, given.width, given.height, given.step
            )
            frame = to_frame(image, self._camera, time_ns, name)
            checks.check_new(raw, frame)
        except SourceError as error:
            bad = BadFrame(arrival_ns, name, str(error))
            return Captured(bad, arrival_ns, num_missed=self._num_missed)
        if encoding is not None:
            image = gray_image(frame)
        message = image_message(image, arrival_ns, raw.sequence)
        return Captured(frame, arrival_ns, message, self._calibration, self._num_missed)

    def _describe(self, device: VideoDevice, given: VideoFormat) -> str:
        config = self._config
        other = given.pixel_format != config.format or (
            config.fps is not None and abs((given.fps or 0) / config.fps - 1) > _MAX_RATE_ERROR
        )
        rate = "" if config.fps is None else f" at {config.fps:g} fps"
        asked = f" ({config.format}{rate} was asked for)" if other else ""
        return f"{device.card} gives {given}{asked}"


class _Checks:
    """What one stream's frames are held against: those before them, and the clock."""

    def __init__(self, config: V4l2Config, given: VideoFormat, clock: WallClock) -> None:
        self._allow_repeats = config.allow_repeats
        self._max_ahead_ns = round(max(_MAX_AHEAD_S, 1 / (given.fps or math.inf)) * 1e9)
        self._clock = clock
        self._sequence: int | None = None
        self._data = b""
        self._newest_ns = 0

    def count_missed(self, raw: RawFrame) -> int:
        """Count the frames that the driver dropped before this one."""
        before, self._sequence = self._sequence, raw.sequence
        if before is None:
            return 0
        missed = (raw.sequence - before - 1) % 2**32
        return missed if missed < 2**31 else 0  # else a driver that counts anew, or not at all

    def time_ns(self, raw: RawFrame) -> int:
        """Return the time of capture; a frame that is damaged, or of no known time, is an error."""
        now_ns = time.monotonic_ns()
        stamp_ns = now_ns if raw.monotonic_ns is None else raw.monotonic_ns
        if raw.damaged:
            raise SourceError("the driver marks the frame as damaged")
        if not now_ns - _MAX_AGE_NS <= stamp_ns <= now_ns + self._max_ahead_ns:
            ahead_s = (stamp_ns - now_ns) / 1e9
            raise SourceError(f"the frame's time stamp is {ahead_s:+.3f} s from its arrival")
        if stamp_ns <= self._newest_ns:
            behind_s = (self._newest_ns - stamp_ns) / 1e9
            raise SourceError(f"the frame's time stamp is {behind_s:.3f} s before an earlier one's")
        self._newest_ns = stamp_ns
        return self._clock.time_ns(stamp_ns)

    def check_new(self, raw: RawFrame, frame: Frame) -> None:
        """Refuse a picture that is the one before; behind a covered lens all are the same."""
        data, self._data = self._data, raw.data
        if self._allow_repeats or raw.data != data:
            return
        if cv2.meanStdDev(frame.image)[1].item() >= MIN_CONTRAST:  # else it is TOO_DARK
            raise SourceError("the picture is the one before, byte for byte: the camera is frozen")


def _wait(*descriptors: int, timeout_s: float) -> set[int]:
    """Wait until one can be read, or has failed; return those."""
    poll = select.poll()
    for descriptor in descriptors:
        poll.register(descriptor, select.POLLIN)
    return {descriptor for descriptor, _ in poll.poll(timeout_s * 1e3)}


def _explain(error: OSError) -> str:
    if error.errno in _ABSENT:
        return "it is not there: plug it in, or name another source.device"
    return _HINTS.get(error.errno or 0, error.strerror or str(error))
