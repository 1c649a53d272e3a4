"""The OAK source on DepthAI itself: pipelines without a device, that deliver real frames."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray

from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpointd.backoff import Backoff
from trigpointd.config import DepthaiConfig
from trigpointd.messages.images import parse_calibration, parse_image, to_frame
from trigpointd.pipeline import Output, Pipeline
from trigpointd.service import serve
from trigpointd.sources.base import BadFrame, Captured
from trigpointd.sources.depthai import DepthaiSource, choose_device, open_camera, set_exposure
from trigpointd.sources.supervised import SupervisedSource

os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")  # as the source does
dai = pytest.importorskip(
    "depthai", reason="OAK cameras need the extra `oak`: pip install 'trigpoint[oak]'"
)

WIDTH, HEIGHT = 128, 80
K = [[100.0, 0, 66.0], [0, 101.0, 38.0], [0, 0, 1]]
RATIONAL = [0.1, -0.2, 1e-3, 2e-3, 0.05, 0.01, -0.02, 3e-3]
FISHEYE = [0.05, -0.02, 3e-3, 1e-3]
SILENT = "then nothing comes"
UNPLUGGED = "then the device is gone"
GUARD_S = 60.0  # only a source that hangs takes so long


def picture(i: int, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """Draw noise (height, width), a different one for each i."""
    return np.random.default_rng(i).integers(0, 256, (height, width), dtype=np.uint8)


def coloured(i: int) -> NDArray[np.uint8]:
    return np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def handler(model: str = "Perspective", coefficients: Sequence[float] = RATIONAL) -> Any:
    """Read a calibration as a device's memory holds it."""
    identity = {"rotationMatrix": np.eye(3).tolist(), "toCameraSocket": -1} | {
        name: {"x": 0, "y": 0, "z": 0} for name in ("translation", "specTranslation")
    }
    camera = {
        "cameraType": int(dai.CameraModel.__members__[model]),
        "width": WIDTH,
        "height": HEIGHT,
        "intrinsicMatrix": K,
        "distortionCoeff": list(coefficients),
        "lensPosition": 0,
        "specHfovDeg": 65.0,
        "extrinsics": identity,
    }
    text = json.dumps({"version": 7, "boardName": "test", "cameraData": [[0, camera]]})
    return dai.CalibrationHandler.fromJson(json.loads(text))


def transformation(calibration: Any) -> Any:
    socket = dai.CameraBoardSocket.CAM_A
    return dai.ImgTransformation(
        WIDTH,
        HEIGHT,
        calibration.getCameraIntrinsics(socket, WIDTH, HEIGHT),
        calibration.getDistortionModel(socket),
        calibration.getDistortionCoefficients(socket),
    )


def image(
    sequence: int, pixels: NDArray[np.uint8] | None = None, kind: str = "GRAY8", **lens: Any
) -> Any:
    """Make a frame as a camera delivers it."""
    made = dai.ImgFrame()
    shown = picture(sequence) if pixels is None else pixels
    made.setCvFrame(shown, getattr(dai.ImgFrame.Type, kind))
    made.setTransformation(transformation(handler(**lens)))
    made.setSequenceNum(sequence)
    made.setTimestamp(timedelta(seconds=time.monotonic()))
    return made


class Sensor(dai.node.ThreadedHostNode):  # type: ignore[name-defined,misc]
    """Sends its images, as a camera does."""

    def __init__(self, images: Iterable[Any]) -> None:
        super().__init__()
        self.output = self.createOutput()
        self.unplug: Callable[[], None] = lambda: None
        self._images = images

    def run(self) -> None:
        # DepthAI ends the process for what escapes from here.
        with contextlib.suppress(dai.MessageQueue.QueueException):
            for item in self._images:
                if item == UNPLUGGED:
                    self.unplug()
                elif item != SILENT:
                    self.output.send(item)


def close_empty(queue: Any) -> None:
    """Close a queue once what is in it was taken; closing throws the rest away."""
    while queue.getSize() > 0:
        time.sleep(0.001)
    queue.close()


class Device:
    """Opens as often as it is told what happens then: images, or an error."""

    def __init__(
        self, *openings: Iterable[Any] | Exception, size: tuple[int, int] | None = None
    ) -> None:
        self._openings = iter(openings)
        self._size = size
        self.pipelines: list[Any] = []

    def open(self, config: DepthaiConfig) -> tuple[Any, Any]:
        opening = next(self._openings)
        if isinstance(opening, Exception):
            raise opening
        pipeline = dai.Pipeline(createImplicitDevice=False)
        sensor = pipeline.create(Sensor, opening)
        output = sensor.output
        if self._size is not None:
            manip = pipeline.create(dai.node.ImageManip)
            manip.setRunOnHost(True)
            manip.initialConfig.setOutputSize(
                *self._size, dai.ImageManipConfig.ResizeMode.CENTER_CROP
            )
            output.link(manip.inputImage)
            output = manip.out
        queue = output.createOutputQueue(maxSize=4, blocking=True)
        sensor.unplug = partial(close_empty, queue)
        self.pipelines.append(pipeline)
        return pipeline, queue


def source_of(device: Device, timeout_s: float = GUARD_S) -> SupervisedSource:
    config = DepthaiConfig(type="depthai", timeout_s=timeout_s)
    camera = DepthaiSource(config, open_pipeline=device.open)
    return SupervisedSource(camera, backoff=Backoff(0.0))


async def take(source: SupervisedSource, count: int) -> list[Captured]:
    """Take so many frames and close the source; what is said of there being none does not count."""
    taken: list[Captured] = []
    async with asyncio.timeout(GUARD_S), contextlib.aclosing(source.frames()) as frames:
        async for captured in frames:
            if isinstance(captured.frame, BadFrame) and captured.frame.reason == "NO_FRAMES":
                continue
            taken.append(captured)
            if len(taken) == count:
                break
    await source.close()
    return taken


def child_environment() -> dict[str, str]:
    root = Path(__file__).parents[2]
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(root), *sys.path])}


def frames_of(device: Device, count: int) -> list[Frame]:
    captured = asyncio.run(take(source_of(device), count))
    frames = [c.frame for c in captured if isinstance(c.frame, Frame)]
    assert len(frames) == count
    return frames


def luma(bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420)[:HEIGHT], np.uint8)


def test_frames_come_in_order_with_their_pixels() -> None:
    device = Device([image(i) for i in range(10)])
    captured = asyncio.run(take(source_of(device), 10))
    for i, one in enumerate(captured):
        assert isinstance(one.frame, Frame)
        assert one.frame.name == f"CAM_A#{i}"
        np.testing.assert_array_equal(one.frame.image, picture(i))
    assert [one.num_missed for one in captured] == [0] * 10


@pytest.mark.parametrize(
    ("kind", "gray"),
    [
        ("NV12", luma),
        ("BGR888i", lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)),
        ("RGB888i", lambda bgr: cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)),
    ],
)
def test_colour_turns_gray_to_the_pixel(
    kind: str, gray: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
) -> None:
    [frame] = frames_of(Device([image(0, coloured(0), kind)]), 1)
    np.testing.assert_array_equal(frame.image, gray(coloured(0)))


def test_rows_with_padding_lose_it() -> None:
    padded = image(0)
    padded.setData(picture(0, WIDTH + 64).ravel())
    padded.setStride(WIDTH + 64)
    [frame] = frames_of(Device([padded]), 1)
    np.testing.assert_array_equal(frame.image, picture(0, WIDTH + 64)[:, :WIDTH])


@pytest.mark.parametrize(
    ("model", "coefficients", "ours"),
    [
        ("Perspective", [*RATIONAL, *[0.0] * 6], "FULL_OPENCV"),
        ("Perspective", [*RATIONAL[:4], *[0.0] * 10], "OPENCV"),
        ("Perspective", [0.0] * 14, "PINHOLE"),
        ("Fisheye", FISHEYE, "OPENCV_FISHEYE"),
    ],
)
def test_the_lens_is_the_one_that_depthai_computes_with(
    model: str, coefficients: list[float], ours: str
) -> None:
    calibration = handler(model, coefficients)
    [frame] = frames_of(Device([image(0, model=model, coefficients=coefficients)]), 1)
    assert frame.camera.model == ours
    points = np.random.default_rng(0).uniform([-0.6, -0.4, 1], [0.6, 0.4, 2], (50, 3))
    theirs = [transformation(calibration).project3DPoint(dai.Point3f(*p)) for p in points]
    np.testing.assert_allclose(
        frame.camera.project(points), [(p.x, p.y) for p in theirs], atol=1e-3
    )


@pytest.mark.parametrize("size", [(64, 40), (64, 48), (128, 72), (48, 48)])
def test_intrinsics_follow_scale_and_crop(size: tuple[int, int]) -> None:
    [frame] = frames_of(Device([image(0)], size=size), 1)
    width, height = size
    scale = max(width / WIDTH, height / HEIGHT)
    assert (frame.camera.width, frame.camera.height) == size == frame.image.shape[::-1]
    cropped = np.array([scale * WIDTH - width, scale * HEIGHT - height]) / 2
    np.testing.assert_allclose(frame.camera.focals_px, (100 * scale, 101 * scale), rtol=1e-5)
    np.testing.assert_allclose(
        frame.camera.K[:2, 2], np.array([66, 38]) * scale - cropped, atol=1e-3
    )
    np.testing.assert_allclose(frame.camera.distortion, RATIONAL, rtol=1e-6)


def without_intrinsics() -> Any:
    made = image(0)
    made.setTransformation(dai.ImgTransformation(WIDTH, HEIGHT))
    return made


def scaled_without_intrinsics() -> Any:
    made = image(0)
    made.setTransformation(dai.ImgTransformation(2 * WIDTH, 2 * HEIGHT).addScale(0.5, 0.5))
    return made


def cylindrical() -> Any:
    made = image(0)
    model = dai.CameraModel.Cylindrical
    made.setTransformation(dai.ImgTransformation(WIDTH, HEIGHT, K, model, []))
    return made


@pytest.mark.parametrize(
    ("unusable", "complaint"),
    [
        (without_intrinsics, "never calibrated"),
        (scaled_without_intrinsics, "never calibrated"),
        (cylindrical, "distortion model 'Cylindrical' is not supported"),
        (lambda: image(0, coefficients=[*RATIONAL, 0.1, *[0.0] * 5]), "more than 8 coefficients"),
    ],
)
def test_a_calibration_that_cannot_be_used_ends_the_source(
    unusable: Callable[[], Any], complaint: str
) -> None:
    device = Device([unusable()])
    with pytest.raises(ConfigError, match=complaint) as caught:
        asyncio.run(take(source_of(device), 1))
    assert "\n" not in str(caught.value)
    assert not device.pipelines[0].isRunning()


def test_frames_are_stamped_with_the_middle_of_their_exposure_in_the_systems_time() -> None:
    moments_s = (time.monotonic() - 100, time.monotonic())
    images = [image(i) for i in range(2)]
    for one, moment_s in zip(images, moments_s, strict=True):
        one.setTimestamp(timedelta(seconds=moment_s))  # the end of the exposure
        settings = one.cam
        settings.exposureTimeUs = 20_000_000
        one.cam = settings
    now_ns = time.time_ns()
    first, second = (frame.time_ns for frame in frames_of(Device(images), 2))
    assert abs(now_ns - second - 10 * 10**9) < 10**9
    assert abs(second - first - 100 * 10**9) < 10**9


def test_gaps_in_the_sequence_are_counted() -> None:
    images = [image(i) for i in (3, 4, 7, 8, 18)]
    captured = asyncio.run(take(source_of(Device(images)), 5))
    assert [one.num_missed for one in captured] == [0, 0, 2, 2, 11]


def raw10(sequence: int) -> Any:
    made = image(sequence)
    made.setType(dai.ImgFrame.Type.RAW10)
    return made


def cut_off(sequence: int) -> Any:
    made = image(sequence)
    made.setData(np.zeros(100, np.uint8))
    return made


@pytest.mark.parametrize(
    ("bad", "detail"), [(raw10, "encoding 'RAW10' is not supported"), (cut_off, "its 100 bytes")]
)
def test_a_frame_that_cannot_be_used_is_reported_and_others_come(
    bad: Callable[[int], Any], detail: str
) -> None:
    device = Device([image(0), bad(1), image(2)])
    before, between, after = (one.frame for one in asyncio.run(take(source_of(device), 3)))
    assert isinstance(between, BadFrame)
    assert between.name == "CAM_A#1"
    assert detail in between.detail
    assert isinstance(before, Frame)
    assert isinstance(after, Frame)
    assert len(device.pipelines) == 1


@pytest.mark.parametrize(
    ("end", "timeout_s", "problem"),
    [
        (UNPLUGGED, GUARD_S, "it was disconnected"),
        (SILENT, 1.0, "no frame in 1 s"),
    ],
)
def test_a_camera_that_is_lost_comes_back(
    end: str, timeout_s: float, problem: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "trigpointd")
    gone = RuntimeError("X_LINK_DEVICE_NOT_FOUND\n")
    device = Device([image(0), image(1), end], gone, gone, gone, [image(500), image(501)])
    captured = asyncio.run(take(source_of(device, timeout_s), 4))
    assert [one.frame.name for one in captured] == [f"CAM_A#{i}" for i in (0, 1, 500, 501)]
    assert captured[-1].num_missed == 0  # a device counts anew when it is opened
    assert not any(pipeline.isRunning() for pipeline in device.pipelines)
    assert [record.message for record in caplog.records] == [
        "camera CAM_A: frames come",
        f"camera CAM_A: {problem}; trying again",
        "camera CAM_A: it cannot be opened: X_LINK_DEVICE_NOT_FOUND; trying again",
        "camera CAM_A: frames come",
    ]


def test_a_description_is_of_what_comes() -> None:
    source = source_of(Device([image(0)]))
    assert source.describe() == f"camera CAM_A: it gives {WIDTH} x {HEIGHT} px"
    asyncio.run(source.close())
    with pytest.raises(SourceError, match="no device"):
        source_of(Device(RuntimeError("no device"))).describe()


def test_what_is_logged_of_a_frame_makes_it_again() -> None:
    (captured,) = asyncio.run(take(source_of(Device([image(3)])), 1))
    assert isinstance(captured.frame, Frame)
    assert captured.image is not None
    assert captured.calibration is not None
    kinds = [(m.channel.message_encoding, m.channel.schema_name, m.data)
             for m in (captured.image, captured.calibration)]  # fmt: skip
    shown, camera = parse_image(*kinds[0]), parse_calibration(*kinds[1]).camera()
    again = to_frame(shown, camera, shown.time_ns, captured.frame.name)
    np.testing.assert_array_equal(again.image, captured.frame.image)
    assert again.camera == captured.frame.camera
    assert again.time_ns == captured.frame.time_ns


async def cancel_when(
    event: threading.Event, source: SupervisedSource, then: Callable[[], None] = lambda: None
) -> None:
    """Cancel a task that takes frames once the event is set, as it is by a frame, do something."""

    async def consume() -> None:
        async with contextlib.aclosing(source.frames()) as frames:
            async for captured in frames:
                if isinstance(captured.frame, Frame):
                    event.set()

    async with asyncio.timeout(GUARD_S):
        task = asyncio.create_task(consume())
        await asyncio.to_thread(event.wait)
        task.cancel()
        then()
        await asyncio.wait([task])
        assert task.cancelled()
        await source.close()


class WatchedQueue:
    """A queue that tells when it is waited on."""

    def __init__(self, queue: Any, waiting: threading.Event) -> None:
        self.close = queue.close
        self._queue = queue
        self._waiting = waiting

    def get(self, timeout: timedelta) -> Any:
        self._waiting.set()
        return self._queue.get(timeout)


def test_cancelling_while_it_waits_for_a_frame_stops_the_camera() -> None:
    waiting = threading.Event()

    class WatchedDevice(Device):
        def open(self, config: DepthaiConfig) -> tuple[Any, Any]:
            pipeline, queue = super().open(config)
            return pipeline, WatchedQueue(queue, waiting)

    device = WatchedDevice([SILENT])
    asyncio.run(cancel_when(waiting, source_of(device, timeout_s=10 * GUARD_S)))
    assert not device.pipelines[0].isRunning()


def test_closing_waits_until_depthai_has_ended() -> None:
    ended = threading.Event()

    def images() -> Iterator[Any]:
        yield image(0)
        time.sleep(0.5)  # a node that takes its time to notice the end
        ended.set()

    frames_of(Device(images()), 1)
    assert ended.is_set()


class Opened:
    """A pipeline that is also its device, and its queue; it tells what was done with it."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.closed = threading.Event()

    def getDefaultDevice(self) -> Opened:
        return self

    def stop(self) -> None:
        self.calls.append("stop")

    def wait(self) -> None:
        self.calls.append("wait")

    def close(self) -> None:
        self.closed.set()


def test_the_end_does_not_wait_for_a_camera_that_is_being_opened_and_closes_it_afterwards() -> None:
    opening, open_now, opened = threading.Event(), threading.Event(), Opened()

    def open_slowly(config: DepthaiConfig) -> tuple[Any, Any]:
        opening.set()
        open_now.wait()
        return opened, opened

    camera = DepthaiSource(DepthaiConfig(type="depthai"), open_pipeline=open_slowly)
    asyncio.run(cancel_when(opening, SupervisedSource(camera)))
    assert not opened.closed.is_set()
    open_now.set()
    assert opened.closed.wait(GUARD_S)
    assert opened.calls == ["stop", "wait"]


def test_a_camera_that_was_opened_in_the_moment_of_the_end_is_closed() -> None:
    opened, finished = Opened(), threading.Event()

    def open_at_once(config: DepthaiConfig) -> tuple[Any, Any]:
        finished.set()
        return opened, opened

    async def scenario() -> None:
        camera = DepthaiSource(DepthaiConfig(type="depthai"), open_pipeline=open_at_once)
        before = set(threading.enumerate())
        first = asyncio.ensure_future(anext(camera.frames()))
        await asyncio.sleep(0)
        finished.wait()  # the loop, which would hear of it, waits as well
        for thread in set(threading.enumerate()) - before:
            thread.join()
        first.cancel()
        await asyncio.wait([first])

    asyncio.run(scenario())
    assert opened.closed.is_set()


def test_sigterm_while_depthai_opens_a_camera_ends_the_daemon_in_order(
    tmp_path: Path, model: FeatureModel
) -> None:
    with MapWriter.create(tmp_path / "m.tpmap", model.identity):
        pass
    # Nobody answers there; DepthAI gives up after ten seconds.
    (tmp_path / "settings.toml").write_text(
        'map = "m.tpmap"\n[source]\ntype = "depthai"\ndevice = "127.0.0.1"\n'
        '[log]\npath = "log.mcap"\n'
    )
    settings = str(tmp_path / "settings.toml")
    program = f"""
import atexit, sys
from trigpointd.cli import main

atexit.register(print, "Python's own end, which crashes DepthAI", flush=True)
sys.argv = ["trigpointd", "--verbose", "run", "--config", {settings!r}]
main()
"""
    with subprocess.Popen(
        [sys.executable, "-c", program],
        env=child_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as daemon:
        assert daemon.stdout is not None
        said = []
        for line in daemon.stdout:
            said.append(line.strip())
            if line.endswith("camera CAM_A: opening 127.0.0.1\n"):
                daemon.terminate()
        assert daemon.wait(GUARD_S) == 0, said
    assert said[-2:] == ["trigpointd: stopping", "trigpointd: no frames, 0 dropped"]
    with (tmp_path / "log.mcap").open("rb") as file:
        assert make_reader(file).get_summary() is not None


def test_cancelling_between_two_tries_does_not_wait_for_the_next() -> None:
    tried = threading.Event()

    def no_device(config: DepthaiConfig) -> tuple[Any, Any]:
        tried.set()
        raise RuntimeError("no device")

    camera = DepthaiSource(DepthaiConfig(type="depthai"), open_pipeline=no_device)
    source = SupervisedSource(camera, backoff=Backoff(20 * GUARD_S, 20 * GUARD_S))
    asyncio.run(cancel_when(tried, source))


def test_a_source_closes_unused_and_twice() -> None:
    async def scenario() -> None:
        source = source_of(Device())
        await source.close()
        await source.close()

    asyncio.run(scenario())


def test_a_source_plays_again_after_closing() -> None:
    source = source_of(Device([image(0)], [image(1)]))

    async def scenario() -> list[Captured]:
        return [*await take(source, 1), *await take(source, 1)]

    assert [one.frame.name for one in asyncio.run(scenario())] == ["CAM_A#0", "CAM_A#1"]


class Statuses:
    """A sink that asks for the end after so many frames."""

    problem = ""

    def __init__(self, count: int, stop: asyncio.Event) -> None:
        self.received: list[dict[str, Any]] = []
        self._count = count
        self._stop = stop

    def publish(self, output: Output) -> None:
        self.received.append(json.loads(output.status))
        if len(self.received) == self._count:
            self._stop.set()

    def close(self) -> None:
        pass


def test_the_daemon_serves_an_oak_camera_until_it_is_told_to_stop(
    tmp_path: Path, model: FeatureModel
) -> None:
    with MapWriter.create(tmp_path / "m.tpmap", model.identity):
        pass
    device = Device(image(2 * i) for i in itertools.count())

    async def scenario(reader: MapReader) -> list[dict[str, Any]]:
        stop = asyncio.Event()
        sink = Statuses(3, stop)
        pipeline = Pipeline(Localizer(model, reader), reader, Rigid3.identity(), "map")
        async with asyncio.timeout(GUARD_S):
            await serve(source_of(device), pipeline, {"sink": sink}, stop)
        return sink.received

    with MapReader.open(tmp_path / "m.tpmap", model.identity) as reader:
        received = asyncio.run(scenario(reader))
    assert received[0]["reason"] == "NO_MAP"
    for status in received:
        assert status["num_missed"] == int(status["frame"].removeprefix("CAM_A#")) / 2
    assert not device.pipelines[0].isRunning()


def device_info(name: str, device_id: str) -> Any:
    return dai.DeviceInfo(
        name,
        device_id,
        dai.XLinkDeviceState.X_LINK_UNBOOTED,
        dai.XLinkProtocol.X_LINK_USB_VSC,
        dai.XLinkPlatform.X_LINK_MYRIAD_X,
        dai.XLinkError_t.X_LINK_SUCCESS,
    )


def test_a_device_is_chosen_by_id_or_name_or_is_the_first() -> None:
    found = [device_info("1.2", "14442C10D13EABCE00"), device_info("10.0.0.7", "18443010")]
    assert choose_device(found, None) is found[0]
    assert choose_device(found, "18443010") is found[1]
    assert choose_device(found, "10.0.0.7") is found[1]


def test_an_address_that_was_not_found_is_tried_all_the_same() -> None:
    chosen = choose_device([device_info("10.0.0.7", "18443010")], "10.0.9.1")
    assert (chosen.name, chosen.protocol) == ("10.0.9.1", dai.XLinkProtocol.X_LINK_TCP_IP)
    with pytest.raises(SourceError, match=r"device 10\.0\.9 is not connected"):
        choose_device([], "10.0.9")


def test_a_device_that_is_not_there_is_looked_for_and_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    tries: list[int] = []
    enough = threading.Event()

    def open_counted(config: DepthaiConfig) -> tuple[Any, Any]:
        tries.append(1)
        if len(tries) == 3:
            enough.set()
        return open_camera(config)

    config = DepthaiConfig(type="depthai", device="no such camera")
    camera = DepthaiSource(config, open_pipeline=open_counted)
    asyncio.run(cancel_when(enough, SupervisedSource(camera, backoff=Backoff(0.0))))
    said = [record.message for record in caplog.records if record.name.startswith("trigpointd")]
    assert len(said) == 1
    assert said[0].startswith(
        "camera CAM_A: device no such camera is not connected, or not free; there are:"
    )


def test_the_exposure_is_fixed_limited_or_left_alone() -> None:
    fixed, limited, automatic = (dai.CameraControl() for _ in range(3))
    set_exposure(fixed, DepthaiConfig(type="depthai", exposure_ms=2.5, iso=400))
    assert (fixed.expManual.exposureTimeUs, fixed.expManual.sensitivityIso) == (2500, 400)
    set_exposure(limited, DepthaiConfig(type="depthai", max_exposure_ms=4))
    assert limited.aeMaxExposureTimeUs == 4000
    set_exposure(automatic, DepthaiConfig(type="depthai"))
    assert automatic.cmdMask == dai.CameraControl().cmdMask


ENDINGS = {
    "by sys.exit in the midst of frames": ("sys.exit(7)", 7),
    "by an error in the midst of frames": ("raise ValueError", 1),
    "by leaving the frames unfinished": ("return", 0),
}


@pytest.mark.parametrize(("statement", "code"), ENDINGS.values(), ids=ENDINGS)
def test_the_process_ends_as_it_wants(statement: str, code: int) -> None:
    program = f"""
import asyncio, itertools, sys
from tests.daemon.test_depthai_source import Device, image, source_of

async def main():
    source = source_of(Device(image(i) for i in itertools.count()))
    async for captured in source.frames():
        if captured.frame.name == "CAM_A#5":
            {statement}

asyncio.run(main())
"""
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env=child_environment(),
        capture_output=True,
        text=True,
        timeout=GUARD_S,
        check=False,
    )
    assert ended.returncode == code, ended.stderr
