"""The camera source on vivid, a virtual camera of the kernel's that breaks on request.

`make test-v4l2` boots a kernel that has it.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import fcntl
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpointd.config import V4l2Config
from trigpointd.sources import videodev2 as v4l2
from trigpointd.sources.base import BadFrame, Captured
from trigpointd.sources.supervised import SupervisedSource
from trigpointd.sources.v4l2 import V4l2Source
from trigpointd.sources.video_device import Kernel, Linux

DRIVER = Path("/sys/bus/platform/drivers/vivid")
DEVICE = Path("/dev/video0")
TIMEOUT_S = 60
FPS = 10
GIVES = "camera /dev/video0: vivid (vivid) gives YUYV, 640 x 480 px at 10 fps"
COMES = "camera /dev/video0: frames come"
pytestmark = pytest.mark.skipif(
    not ((DRIVER / "vivid.0").exists() and os.geteuid() == 0),
    reason="needs root and the driver vivid as the only camera; run `make test-v4l2`",
)


CTRL_FLAG_NEXT_CTRL = 0x80000000
VIDIOC_G_CTRL = 0xC008561B


def get_control(number: int) -> int:
    fd = os.open(DEVICE, os.O_RDWR)
    try:
        control = v4l2.Control(number)
        fcntl.ioctl(fd, VIDIOC_G_CTRL, control)
        return int(control.value)
    finally:
        os.close(fd)


def set_control(name: str, value: int = 1) -> None:
    """Set a control of the driver, such as press a button that breaks something."""
    fd = os.open(DEVICE, os.O_RDWR)
    try:
        query = v4l2.QueryControl()
        while query.name.decode() != name:
            query.id |= CTRL_FLAG_NEXT_CTRL
            fcntl.ioctl(fd, v4l2.VIDIOC_QUERYCTRL, query)
        fcntl.ioctl(fd, v4l2.VIDIOC_S_CTRL, v4l2.Control(query.id, value))
    finally:
        os.close(fd)


def make_source(kernel: Kernel | None = None, **fields: Any) -> SupervisedSource:
    camera = "PINHOLE 640 480 460 460 320 240"
    given = {"type": "v4l2", "device": DEVICE, "camera": camera, "fps": FPS, "timeout_s": 30}
    return SupervisedSource(V4l2Source(V4l2Config.model_validate(given | fields), kernel=kernel))


@contextlib.asynccontextmanager
async def streaming(
    kernel: Kernel | None = None, **fields: Any
) -> AsyncIterator[Callable[[Callable[[Captured], bool]], Awaitable[Captured]]]:
    """Give a function that takes frames until one is as asked for."""
    async with contextlib.aclosing(make_source(kernel, **fields).frames()) as frames:

        async def until(wanted: Callable[[Captured], bool]) -> Captured:
            async with asyncio.timeout(TIMEOUT_S):
                while not wanted(captured := await anext(frames)):
                    pass
            return captured

        yield until


def is_good(captured: Captured) -> bool:
    return isinstance(captured.frame, Frame)


def detail(captured: Captured) -> str:
    return captured.frame.detail if isinstance(captured.frame, BadFrame) else ""


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level("INFO")
    return caplog


def wait_for(log: pytest.LogCaptureFixture, num_messages: int) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while len(log.messages) < num_messages:
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


class Witness(Linux):
    """The kernel, and the stamp that the driver gave each sequence number."""

    def __init__(self) -> None:
        self.stamps_ns: dict[int, int] = {}

    def ioctl(self, fd: int, request: int, argument: ctypes.Structure | ctypes.c_int) -> None:
        super().ioctl(fd, request, argument)
        if request == v4l2.VIDIOC_DQBUF and isinstance(argument, v4l2.Buffer):
            stamp = argument.timestamp
            self.stamps_ns[argument.sequence] = stamp.tv_sec * 10**9 + stamp.tv_usec * 1000


@pytest.mark.parametrize("pixel_format", ["YUYV", "GREY", "NV12"])
def test_frames_arrive_with_the_drivers_times_and_numbers(pixel_format: str) -> None:
    witness = Witness()

    async def take() -> list[Captured]:
        async with streaming(witness, format=pixel_format) as until:
            return [await until(is_good) for _ in range(8)]

    captures = asyncio.run(take())
    numbers = [int(captured.frame.name.split("#")[1]) for captured in captures]
    num_missed = captures[-1].num_missed - captures[0].num_missed
    assert numbers[-1] - numbers[0] == 7 + num_missed
    stamps_ns = [witness.stamps_ns[number] for number in numbers]
    times_ns = [captured.frame.time_ns for captured in captures]
    assert np.all(np.diff(times_ns) > 0)
    assert np.diff(times_ns).tolist() == np.diff(stamps_ns).tolist()
    clocks_apart_ns = time.time_ns() - time.monotonic_ns()
    assert abs(times_ns[0] - stamps_ns[0] - clocks_apart_ns) < 10**9
    for captured in captures:
        assert isinstance(captured.frame, Frame)
        # Eight colour bars, from white to black, beneath the text.
        bars = np.median(captured.frame.image[300:, 40::80], axis=0)
        assert np.all(np.diff(bars) < 0)


def test_motion_jpeg_is_asked_for_yuyv_is_given_and_taken(log: pytest.LogCaptureFixture) -> None:
    async def take() -> Captured:
        async with streaming(format="MJPG") as until:
            return await until(is_good)

    assert is_good(asyncio.run(take()))
    assert log.messages == [f"{GIVES} (MJPG at 10 fps was asked for)", COMES]


def test_a_size_that_it_lacks_is_an_error() -> None:
    with pytest.raises(ConfigError, match=r"it gives 640 x \d+ px, but source.camera is for 650"):
        make_source(camera="PINHOLE 650 490 460 460 320 240").describe()


def test_a_gain_is_fixed_and_given_back_to_the_camera() -> None:
    make_source(gain=31).describe()
    assert (get_control(v4l2.CID_AUTOGAIN), get_control(v4l2.CID_GAIN)) == (0, 31)
    make_source().describe()
    assert get_control(v4l2.CID_AUTOGAIN) == 1


def test_a_gain_out_of_range_or_an_exposure_that_it_lacks_is_an_error() -> None:
    with pytest.raises(ConfigError, match=r"it takes a source\.gain of 0 to 255, not of 256"):
        make_source(gain=256).describe()
    with pytest.raises(ConfigError, match=r"it has no control for source\.exposure_ms"):
        make_source(exposure_ms=5).describe()


def test_a_frame_that_is_marked_as_damaged_is_bad_and_the_next_is_good() -> None:
    async def take() -> str:
        async with streaming() as until:
            await until(is_good)
            set_control("Inject V4L2_BUF_FLAG_ERROR")
            bad = await until(lambda captured: not is_good(captured))
            await until(is_good)
            return detail(bad)

    assert asyncio.run(take()) == "the driver marks the frame as damaged"


def test_dropped_frames_are_counted() -> None:
    async def take() -> None:
        async with streaming() as until:
            await until(is_good)
            set_control("Percentage of Dropped Buffers", 50)
            await until(lambda captured: captured.num_missed > 2)

    try:
        asyncio.run(take())
    finally:
        set_control("Percentage of Dropped Buffers", 0)


def test_a_picture_that_never_changes_is_a_frozen_camera() -> None:
    async def take() -> str:
        async with streaming() as until:
            return detail(await until(lambda captured: not is_good(captured)))

    set_control("OSD Text Mode", 2)  # none: nothing moves
    try:
        assert asyncio.run(take()).endswith("the camera is frozen")
    finally:
        set_control("OSD Text Mode", 0)


def test_an_error_of_the_stream_is_outlived(log: pytest.LogCaptureFixture) -> None:
    async def take() -> None:
        async with streaming() as until:
            await until(is_good)
            set_control("Inject Fatal Streaming Error")
            await until(lambda captured: is_good(captured) and len(log.messages) == 4)

    asyncio.run(take())
    error = "input/output error; if it stays, check the cable and the power"
    assert log.messages == [GIVES, COMES, f"camera /dev/video0: {error}; trying again", COMES]


def test_a_camera_that_is_unplugged_is_waited_for(log: pytest.LogCaptureFixture) -> None:
    absent = "it is not there: plug it in, or name another source.device"

    async def take() -> None:
        async with streaming() as until:
            await until(is_good)
            waiting = asyncio.ensure_future(until(lambda _: len(log.messages) == 4))
            (DRIVER / "unbind").write_text("vivid.0")
            await asyncio.to_thread(wait_for, log, 3)
            with pytest.raises(SourceError, match=absent):
                make_source().describe()
            (DRIVER / "bind").write_text("vivid.0")
            assert is_good(await waiting)

    asyncio.run(take())
    assert log.messages == [GIVES, COMES, f"camera /dev/video0: {absent}; trying again", COMES]
