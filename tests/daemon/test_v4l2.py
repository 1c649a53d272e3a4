"""The camera source on a driver that does what cameras do on bad days."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.daemon.fake_v4l2 import FakeKernel, Filled, Knob, Plugged
from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Failed, Frame, LocalFeatures, Lost, Reason
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpointd.backoff import Backoff
from trigpointd.config import V4l2Config
from trigpointd.pipeline import Output
from trigpointd.sinks.mcap import McapLog
from trigpointd.sources import videodev2 as v4l2
from trigpointd.sources.base import BadFrame, Captured, Source
from trigpointd.sources.mcap import McapSource
from trigpointd.sources.supervised import SupervisedSource
from trigpointd.sources.v4l2 import V4l2Source

WIDTH, HEIGHT = 8, 4
CAMERA = f"OPENCV {WIDTH} {HEIGHT} 7 7.5 4 2 -0.1 0.02 0.003 -0.004"
GIVES = "camera /dev/video7: Fake Camera (fake) gives YUYV, 8 x 4 px at 30 fps"
COMES = "camera /dev/video7: frames come"
GONE = (
    "camera /dev/video7: it is not there: plug it in, or name another source.device; trying again"
)
SILENT = "camera /dev/video7: no usable frame in 0.05 s"
NODEV = OSError(errno.ENODEV, "No such device")
EIO = OSError(errno.EIO, "Input/output error")
TIMEOUT_S = 30


def picture(i: int) -> NDArray[np.uint8]:
    """Draw noise, a different one for each i."""
    return np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def yuyv(i: int) -> bytes:
    return np.stack([picture(i), np.full_like(picture(i), 77)], axis=2).tobytes()


def jpeg(i: int) -> bytes:
    return bytes(cv2.imencode(".jpg", picture(i))[1])


def filled(i: int, **fields: Any) -> Filled:
    return Filled(yuyv(i), **{"sequence": i, **fields})


def make_source(
    kernel: FakeKernel, backoff: Backoff | None = None, **fields: Any
) -> SupervisedSource:
    given = {"type": "v4l2", "device": Path("/dev/video7"), "camera": CAMERA, **fields}
    camera = V4l2Source(V4l2Config.model_validate(given), kernel=kernel)
    return SupervisedSource(camera, backoff=backoff or Backoff(1e-3, 4e-3))


async def collect(source: Source, count: int) -> list[Captured]:
    """Take so many frames; what is said of there being none does not count."""
    captures: list[Captured] = []
    async with asyncio.timeout(TIMEOUT_S), contextlib.aclosing(source.frames()) as frames:
        while len(captures) < count:
            captured = await anext(frames)
            if not (isinstance(captured.frame, BadFrame) and captured.frame.reason == "NO_FRAMES"):
                captures.append(captured)
    return captures


def take(kernel: FakeKernel, count: int, **fields: Any) -> list[Captured]:
    """Take frames, after which the camera must be closed, whatever happened to it."""
    captures = asyncio.run(collect(make_source(kernel, **fields), count))
    assert not kernel.open_descriptors
    return captures


def take_all(*stream: Filled, **fields: Any) -> list[Captured]:
    return take(FakeKernel(Plugged(stream)), len(stream), **fields)


def details(captures: list[Captured]) -> list[str]:
    """Say of each frame what is wrong with it."""
    frames = [captured.frame for captured in captures]
    return [frame.detail if isinstance(frame, BadFrame) else "" for frame in frames]


def image(captured: Captured) -> NDArray[np.uint8]:
    assert isinstance(captured.frame, Frame)
    return captured.frame.image


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    """What the daemon would say."""
    caplog.set_level("INFO")
    return caplog


# The structures


@pytest.mark.skipif(ctypes.sizeof(ctypes.c_long) != 8, reason="the numbers are of 64-bit Linux")
def test_structures_and_ioctls_are_those_of_the_kernel() -> None:
    sizes = {
        v4l2.Capability: 104, v4l2.PixFormat: 48, v4l2.Format: 208, v4l2.StreamParm: 204,
        v4l2.CaptureParm: 40, v4l2.RequestBuffers: 20, v4l2.Timecode: 16, v4l2.Buffer: 88,
        v4l2.QueryControl: 68, v4l2.Control: 8,
    }  # fmt: skip
    assert {kind: ctypes.sizeof(kind) for kind in sizes} == sizes
    assert v4l2.Format.fmt.offset == 8
    assert v4l2.StreamParm.parm.offset == 4
    offsets = {"timestamp": 24, "timecode": 40, "sequence": 56, "memory": 60, "m": 64, "length": 72}
    assert {name: getattr(v4l2.Buffer, name).offset for name in offsets} == offsets
    numbers = {
        "QUERYCAP": 0x80685600, "S_FMT": 0xC0D05605, "REQBUFS": 0xC0145608,
        "QUERYBUF": 0xC0585609, "QBUF": 0xC058560F, "DQBUF": 0xC0585611,
        "STREAMON": 0x40045612, "STREAMOFF": 0x40045613,
        "G_PARM": 0xC0CC5615, "S_PARM": 0xC0CC5616,
        "S_CTRL": 0xC008561C, "QUERYCTRL": 0xC0445624,
    }  # fmt: skip
    assert {name: getattr(v4l2, f"VIDIOC_{name}") for name in numbers} == numbers
    assert v4l2.fourcc("YUYV") == 0x56595559
    assert v4l2.fourcc_name(0x56595559) == "YUYV"


# What a frame becomes


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("pixel_format", ["YUYV", "GREY", "NV12"])
def test_raw_formats_give_their_luma(pixel_format: str, padding: int) -> None:
    rows = picture(1)
    if pixel_format == "YUYV":
        rows = np.frombuffer(yuyv(1), np.uint8).reshape(HEIGHT, -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=9).tobytes()
    if pixel_format == "NV12":
        data += bytes([200]) * (HEIGHT // 2 * (WIDTH + padding))
    camera = Plugged([Filled(data)], pixel_format, padding=padding)
    (captured,) = take(FakeKernel(camera), 1, format=pixel_format)
    np.testing.assert_array_equal(image(captured), picture(1))
    assert captured.frame.name == "video7#0"


def without_huffman_tables(file: bytes) -> bytes:
    """Leave out what most cameras leave out of Motion JPEG: the standard's own tables."""
    while (start := file.find(b"\xff\xc4")) >= 0:
        length = int.from_bytes(file[start + 2 : start + 4], "big")
        file = file[:start] + file[start + 2 + length :]
    return file


def test_motion_jpeg_is_decoded_with_and_without_tables_and_padding() -> None:
    data = jpeg(1)
    stream = [Filled(data), Filled(without_huffman_tables(data)), Filled(data + bytes(500))]
    assert len(stream[1].data) < len(data)
    captures = take(FakeKernel(Plugged(stream, "MJPG")), 3, format="MJPG")
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    for captured in captures:
        np.testing.assert_array_equal(image(captured), expected)


def test_frames_carry_the_configured_intrinsics() -> None:
    (captured,) = take_all(filled(1))
    assert isinstance(captured.frame, Frame)
    assert captured.frame.camera == Camera.from_text(CAMERA)


@pytest.mark.parametrize("pixel_format", ["YUYV", "MJPG"])
def test_a_log_of_the_camera_replays_to_the_bit(tmp_path: Path, pixel_format: str) -> None:
    encode = yuyv if pixel_format == "YUYV" else jpeg
    stream = [Filled(encode(i), i) for i in range(3)]
    captures = take(FakeKernel(Plugged(stream, pixel_format)), 3, format=pixel_format)
    mcap_log = McapLog(tmp_path / "log.mcap", "trigpoint/test")
    for captured in captures:
        mcap_log.publish(Output(captured, Failed("BAD_MAP", ""), None, b"{}"))
    mcap_log.close()
    recording = McapSource(tmp_path / "log.mcap")
    replayed = asyncio.run(collect(recording, 3))
    asyncio.run(recording.close())
    for captured, again in zip(captures, replayed, strict=True):
        assert isinstance(captured.frame, Frame)
        assert isinstance(again.frame, Frame)
        np.testing.assert_array_equal(again.frame.image, captured.frame.image)
        assert again.frame.camera == captured.frame.camera
        assert again.frame.time_ns == captured.frame.time_ns
        assert again.log_time_ns == captured.log_time_ns


# When it was


def test_stamps_are_of_the_wall_clock_and_keep_the_drivers_distances() -> None:
    now_ns = time.monotonic_ns() // 1000 * 1000
    # Some drivers are ahead of themselves by nearly a frame: vivid by 0.18 s of 0.2.
    stamps_ns = [now_ns - 90_000_000, now_ns - 60_000_000, now_ns + 180_000_000]
    stream = [filled(i, monotonic_ns=stamp) for i, stamp in enumerate(stamps_ns)]
    captures = take(FakeKernel(Plugged(stream, fps=5)), 3)
    times_ns = [captured.frame.time_ns for captured in captures]
    assert details(captures) == ["", "", ""]
    assert np.diff(times_ns).tolist() == np.diff(stamps_ns).tolist()
    clocks_apart_ns = time.time_ns() - time.monotonic_ns()
    assert abs(times_ns[0] - stamps_ns[0] - clocks_apart_ns) < 10**8


def test_a_driver_without_stamps_gives_the_time_of_arrival() -> None:
    before_ns = time.time_ns()
    captures = take_all(filled(1, flags=0, monotonic_ns=0), filled(2, flags=0, monotonic_ns=0))
    assert details(captures) == ["", ""]
    first, second = (captured.frame.time_ns for captured in captures)
    assert before_ns - 10**7 < first < second < time.time_ns() + 10**7


@pytest.mark.parametrize("ahead_s", [-3600, -7, 7])
def test_a_stamp_far_from_now_makes_a_bad_frame(ahead_s: int) -> None:
    stamp_ns = max(time.monotonic_ns() + ahead_s * 10**9, 0)
    first, bad, last = details(take_all(filled(0), filled(1, monotonic_ns=stamp_ns), filled(2)))
    assert "s from its arrival" in bad
    assert (first, last) == ("", "")


def test_time_that_goes_back_makes_bad_frames_until_it_has_caught_up() -> None:
    now_ns = time.monotonic_ns() // 1000 * 1000
    offsets_ms = [0, 30, 10, 20, 30, 40]
    stream = [filled(i, monotonic_ns=now_ns + ms * 10**6) for i, ms in enumerate(offsets_ms)]
    captures = take_all(*stream)
    late = "the frame's time stamp is {} s before an earlier one's"
    assert details(captures) == [
        "", "", late.format("0.020"), late.format("0.010"), late.format("0.000"), "",
    ]  # fmt: skip


# Bad frames, and frames that never came


def test_a_frame_that_the_driver_marks_as_damaged_is_bad_and_the_stream_goes_on() -> None:
    damaged = filled(1, flags=v4l2.BUF_FLAG_ERROR | v4l2.BUF_FLAG_TIMESTAMP_MONOTONIC)
    captures = take_all(filled(0), damaged, filled(2))
    assert details(captures) == ["", "the driver marks the frame as damaged", ""]
    # A log must not replay it as a good one.
    assert [captured.image is None for captured in captures] == [False, True, False]
    assert captures[0].frame.time_ns < captures[1].frame.time_ns < captures[2].frame.time_ns


@pytest.mark.parametrize("length", [0, 1, WIDTH * HEIGHT, 2 * WIDTH * HEIGHT - 1])
def test_a_short_buffer_is_a_bad_frame(length: int) -> None:
    first, bad, last = details(take_all(filled(0), Filled(yuyv(1)[:length]), filled(2)))
    assert bad.endswith(f"does not fit its {length} bytes")
    assert (first, last) == ("", "")


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8", bytes(range(256)), jpeg(1)[:300], b"\xff\xd8\xff\xe0" + bytes(99)]
)
def test_motion_jpeg_that_is_garbage_is_a_bad_frame(data: bytes) -> None:
    camera = Plugged([Filled(jpeg(0)), Filled(data), Filled(jpeg(2))], "MJPG")
    first, bad, last = details(take(FakeKernel(camera), 3, format="MJPG"))
    assert "image" in bad
    assert (first, last) == ("", "")


def test_motion_jpeg_of_another_size_is_a_bad_frame() -> None:
    large = bytes(cv2.imencode(".jpg", np.zeros((8, 16), np.uint8))[1])
    (bad,) = details(take(FakeKernel(Plugged([Filled(large)], "MJPG")), 1, format="MJPG"))
    assert "16 x 8 px" in bad


def test_a_frozen_picture_is_not_taken_for_a_new_one() -> None:
    stream = [filled(0), Filled(yuyv(0), 1), Filled(yuyv(0), 2), filled(3)]
    frozen = "the picture is the one before, byte for byte: the camera is frozen"
    assert details(take_all(*stream)) == ["", frozen, frozen, ""]
    assert details(take_all(*stream, allow_repeats=True)) == [""] * 4


def one_keypoint(model: FeatureModel) -> LocalFeatures:
    descriptor, place = (
        np.eye(1, dim, dtype=np.float32)
        for dim in (model.identity.descriptor_dim, model.identity.global_dim)
    )
    scores = np.ones(1, np.float32)
    return LocalFeatures(np.ones((1, 2), np.float32), descriptor, scores, place[0])


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("pixel_format", ["GREY", "MJPG"])
def test_behind_a_covered_lens_all_pictures_are_alike_and_the_camera_is_not_frozen(
    pixel_format: str, level: int, model: FeatureModel, tmp_path: Path
) -> None:
    blank = np.full((HEIGHT, WIDTH), level, np.uint8)
    blank[1, 1] ^= 1  # a pixel that is always on
    data = blank.tobytes() if pixel_format == "GREY" else bytes(cv2.imencode(".jpg", blank)[1])
    camera = Plugged([Filled(data, i) for i in range(3)], pixel_format)
    captures = take(FakeKernel(camera), 3, format=pixel_format)
    assert details(captures) == ["", "", ""]
    with MapWriter.create(tmp_path / "m.tpmap", model.identity) as writer:
        writer.add("anchor", Camera.from_text(CAMERA), Rigid3.identity(), one_keypoint(model))
    with MapReader.open(tmp_path / "m.tpmap", model.identity) as reader:
        for captured in captures:
            assert isinstance(captured.frame, Frame)
            result = Localizer(model, reader).localize(captured.frame)
            assert isinstance(result, Lost)
            assert result.reason == Reason.TOO_DARK


def test_gaps_in_the_sequence_are_counted_over_all_streams() -> None:
    streams = ([0, 1, 4, 5, 7], [3, 5], [2**32 - 2, 0, 1], [9, 9, 4])
    plugged = (Plugged([*map(filled, numbers), EIO]) for numbers in streams)
    counts = [captured.num_missed for captured in take(FakeKernel(*plugged), 13)]
    assert counts == [0, 0, 2, 2, 3, 3, 4, 4, 5, 5, 5, 5, 5]


# What the camera is asked for, and what it gives


def test_the_camera_is_asked_for_what_is_configured(log: pytest.LogCaptureFixture) -> None:
    kernel = FakeKernel(Plugged([Filled(picture(0).tobytes())], "GREY"))
    take(kernel, 1, format="GREY", fps=30)
    assert kernel.requests == [("GREY", WIDTH, HEIGHT)]
    assert kernel.rates == [30]
    assert log.messages == [
        "camera /dev/video7: Fake Camera (fake) gives GREY, 8 x 4 px at 30 fps",
        COMES,
    ]


def test_another_format_or_rate_is_taken_and_said(log: pytest.LogCaptureFixture) -> None:
    captures = take(FakeKernel(Plugged([filled(0)], "YUYV")), 1, format="MJPG", fps=60)
    np.testing.assert_array_equal(image(captures[0]), picture(0))
    assert log.messages == [
        GIVES + " (MJPG at 60 fps was asked for)",
        COMES,
    ]


def test_a_driver_that_knows_no_rate_is_taken(log: pytest.LogCaptureFixture) -> None:
    assert details(take(FakeKernel(Plugged([filled(0)], fps=None)), 1)) == [""]
    assert log.messages[0] == "camera /dev/video7: Fake Camera (fake) gives YUYV, 8 x 4 px"


MODE, EXPOSURE = v4l2.CID_EXPOSURE_AUTO, v4l2.CID_EXPOSURE_ABSOLUTE
PRIORITY = v4l2.CID_EXPOSURE_AUTO_PRIORITY
GAIN, AUTOGAIN = v4l2.CID_GAIN, v4l2.CID_AUTOGAIN


def knobs() -> dict[int, Knob]:
    """The controls of a webcam."""
    return {
        MODE: Knob(0, 3, 3),
        EXPOSURE: Knob(3, 2047, 250),
        PRIORITY: Knob(0, 1, 0),
        GAIN: Knob(0, 100, 20),
        AUTOGAIN: Knob(0, 1, 1),
    }


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        ({}, {MODE: 3, PRIORITY: 0, AUTOGAIN: 1}),
        ({"keep_rate": False}, {MODE: 3, PRIORITY: 1, AUTOGAIN: 1}),
        ({"exposure_ms": 4.26}, {MODE: 1, EXPOSURE: 43, PRIORITY: 0, AUTOGAIN: 1}),
        ({"exposure_ms": 0.3, "gain": 0},
         {MODE: 1, EXPOSURE: 3, PRIORITY: 0, AUTOGAIN: 0, GAIN: 0}),
    ],
)  # fmt: skip
def test_exposure_and_gain_are_fixed_or_left_to_the_camera(
    settings: dict[str, Any], values: dict[int, int]
) -> None:
    controls = knobs()
    assert details(take(FakeKernel(Plugged([filled(0)], controls=controls)), 1, **settings)) == [""]
    found = {number: knob.value for number, knob in controls.items()}
    assert {number: value for number, value in found.items() if value is not None} == values


def test_what_nobody_asked_for_may_be_lacking_fixed_or_refused() -> None:
    controls = {
        MODE: Knob(0, 3, 3, flags=v4l2.CTRL_FLAG_READ_ONLY),
        PRIORITY: Knob(0, 1, 0, error=EIO),
    }
    assert details(take(FakeKernel(Plugged([filled(0)], controls=controls)), 1)) == [""]


DENIED = OSError(errno.EACCES, "Permission denied")


@pytest.mark.parametrize(
    ("changes", "settings", "message"),
    [
        ({EXPOSURE: None}, {"exposure_ms": 4}, "it has no control for source.exposure_ms; leave"),
        ({GAIN: None}, {"gain": 4}, "it has no control for source.gain; leave that out"),
        ({GAIN: Knob(0, 9, 0, flags=v4l2.CTRL_FLAG_DISABLED)}, {"gain": 4},
         "it has no control for source.gain; leave that out"),
        ({}, {"exposure_ms": 500}, "it takes a source.exposure_ms of 0.3 to 204.7, not of 500"),
        ({}, {"exposure_ms": 0.01}, "it takes a source.exposure_ms of 0.3 to 204.7, not of 0.01"),
        ({}, {"gain": 101}, "it takes a source.gain of 0 to 100, not of 101"),
        ({EXPOSURE: Knob(3, 2047, 250, error=DENIED)}, {"exposure_ms": 4},
         r"it does not take source.exposure_ms = 4 \(Permission denied\); leave that out"),
    ],
)  # fmt: skip
def test_an_exposure_or_gain_that_the_camera_cannot_take_ends_the_start(
    changes: dict[int, Knob | None], settings: dict[str, Any], message: str
) -> None:
    controls = {number: knob for number, knob in (knobs() | changes).items() if knob is not None}
    kernel = FakeKernel(Plugged([filled(0)], controls=controls))
    with pytest.raises(ConfigError, match=f"^camera /dev/video7: {message}") as caught:
        take(kernel, 1, **settings)
    assert "\n" not in str(caught.value)
    assert not kernel.open_descriptors


def test_a_camera_that_fails_while_it_is_set_up_is_tried_again(
    log: pytest.LogCaptureFixture,
) -> None:
    failing = knobs() | {GAIN: Knob(0, 100, 20, error=EIO)}
    kernel = FakeKernel(Plugged(controls=failing), Plugged([filled(0)], controls=knobs()))
    assert details(take(kernel, 1, gain=7)) == [""]
    assert "input/output error" in log.messages[0]


WRONG = [
    (Plugged(width=16), "it gives 16 x 4 px, but source.camera is for 8 x 4 px"),
    (Plugged(pixel_format="H264"), "it gives H264, which cannot be read, where YUYV was asked for"),
    (Plugged(field=4), "it gives interlaced pictures; choose a progressive input"),
    (Plugged(capabilities=v4l2.CAP_STREAMING), "not a camera that streams"),
    (Plugged(capabilities=v4l2.CAP_VIDEO_CAPTURE), "not a camera that streams"),
]


@pytest.mark.parametrize(("camera", "message"), WRONG)
def test_a_camera_that_cannot_give_what_is_needed_ends_the_start(
    camera: Plugged, message: str
) -> None:
    for act in (lambda kernel: take(kernel, 1), lambda kernel: make_source(kernel).describe()):
        kernel = FakeKernel(camera)
        with pytest.raises(ConfigError, match=message) as caught:
            act(kernel)
        assert str(caught.value).startswith("camera /dev/video7: ")
        assert "\n" not in str(caught.value)
        assert not kernel.open_descriptors


def test_a_file_that_is_no_video_device_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", Path("/dev/null")):
        config = V4l2Config.model_validate({"type": "v4l2", "device": path, "camera": CAMERA})
        with pytest.raises(ConfigError, match="not a video device; name one such as /dev/video0"):
            V4l2Source(config).describe()


def test_it_says_what_a_camera_delivers_and_closes_it() -> None:
    kernel = FakeKernel(Plugged(fps=15))
    assert make_source(kernel, fps=15).describe() == (
        "camera /dev/video7: Fake Camera (fake) gives YUYV, 8 x 4 px at 15 fps"
    )
    assert not kernel.open_descriptors
    with pytest.raises(SourceError, match="camera /dev/video7: it is not there: plug it in"):
        make_source(kernel).describe()


# Cameras that go and come


def test_a_camera_that_is_unplugged_and_comes_back_is_said_once_each(
    log: pytest.LogCaptureFixture,
) -> None:
    absent = [OSError(errno.ENOENT, "No such file or directory")] * 20
    kernel = FakeKernel(
        Plugged([filled(0), filled(1), NODEV]),
        *absent,
        Plugged([filled(2), filled(3), NODEV]),
        *absent,
        Plugged([filled(4), filled(5)]),
    )
    captures = take(kernel, 6)
    assert [captured.frame.name for captured in captures] == [f"video7#{i}" for i in range(6)]
    assert kernel.num_opened == 43
    assert log.messages == [GIVES, COMES, GONE, COMES, GONE, COMES]


def test_a_camera_that_is_not_there_at_the_start_is_waited_for(
    log: pytest.LogCaptureFixture,
) -> None:
    absent = [OSError(errno.ENOENT, "No such file or directory")] * 5
    assert details(take(FakeKernel(*absent, Plugged([filled(0)])), 1)) == [""]
    assert log.messages == [GONE, GIVES, COMES]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (EIO, "input/output error; if it stays, check the cable and the power"),
        (OSError(errno.EBUSY, "busy"), "another program uses it; end that one"),
        (OSError(errno.EPROTO, "Protocol error"), "Protocol error"),
    ],
)
def test_errors_while_it_streams_or_is_opened_are_outlived(
    error: OSError, message: str, log: pytest.LogCaptureFixture
) -> None:
    kernel = FakeKernel(Plugged([filled(0), error]), error, Plugged([filled(1)]))
    assert details(take(kernel, 2)) == ["", ""]
    assert log.messages == [GIVES, COMES, f"camera /dev/video7: {message}; trying again", COMES]


def test_after_a_start_a_wrong_camera_is_waited_out(log: pytest.LogCaptureFixture) -> None:
    kernel = FakeKernel(
        Plugged([filled(0), NODEV]), Plugged(width=16), Plugged(width=16), Plugged([filled(1)])
    )
    assert details(take(kernel, 2)) == ["", ""]
    assert log.messages[:3] == [GIVES, COMES, GONE]
    assert "it gives 16 x 4 px" in log.messages[3]
    assert log.messages[4:] == [COMES]


def test_a_camera_that_falls_silent_is_opened_again(log: pytest.LogCaptureFixture) -> None:
    kernel = FakeKernel(Plugged([filled(0)]), Plugged([]), Plugged([filled(1)]))
    assert details(take(kernel, 2, timeout_s=0.05)) == ["", ""]
    assert log.messages == [
        GIVES,
        COMES,
        f"{SILENT}: it sends nothing; trying again",
        COMES,
    ]


def test_a_camera_that_gives_only_bad_frames_is_opened_again(log: pytest.LogCaptureFixture) -> None:
    bad = [filled(0, flags=v4l2.BUF_FLAG_ERROR)]
    source = make_source(FakeKernel(Plugged(bad * 100_000), Plugged([filled(1)])), timeout_s=0.05)

    async def frames_until_a_good_one() -> Captured:
        async with asyncio.timeout(TIMEOUT_S), contextlib.aclosing(source.frames()) as frames:
            async for captured in frames:
                if isinstance(captured.frame, Frame):
                    return captured
        raise AssertionError

    assert asyncio.run(frames_until_a_good_one()).frame.name == "video7#1"
    assert log.messages == [
        GIVES,
        f"{SILENT}: the driver marks the frame as damaged; trying again",
        COMES,
    ]


# Ends


@pytest.mark.parametrize("state", ["waits for a frame", "waits to try again", "holds a frame"])
def test_it_can_be_ended_whatever_it_does_and_leaves_nothing_open(state: str) -> None:
    cameras = {
        "waits for a frame": [Plugged()],
        "waits to try again": [],
        "holds a frame": [Plugged([filled(0), filled(1)])],
    }
    kernel = FakeKernel(*cameras[state])
    source = make_source(kernel, Backoff(3600, 3600))

    async def take_all(frames: AsyncIterator[object]) -> None:
        async for _ in frames:  # also that there are none yet
            pass

    async def begin_and_end() -> None:
        async with contextlib.aclosing(source.frames()) as frames:
            if state == "holds a frame":
                await anext(frames)
                return
            waiting = asyncio.create_task(take_all(frames))
            begun = kernel.streaming if cameras[state] else kernel.asked
            assert await asyncio.to_thread(begun.wait, TIMEOUT_S)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting

    async def within_the_limit() -> None:
        await asyncio.wait_for(begin_and_end(), TIMEOUT_S)
        await source.close()

    asyncio.run(within_the_limit())
    assert kernel.num_opened == 1
    assert not kernel.open_descriptors
