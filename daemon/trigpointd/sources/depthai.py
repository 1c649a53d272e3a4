"""Frames from an OAK camera, through DepthAI."""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import AsyncGenerator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from typing import Any, TypeVar

import numpy as np

from trigpoint.camera import Camera
from trigpoint.camera_messages import Calibration, Image
from trigpoint.errors import ConfigError, SourceError
from trigpointd.backoff import Backoff
from trigpointd.clock import WallClock
from trigpointd.config import DepthaiConfig
from trigpointd.messages.foxglove import calibration_message, gray_image, image_message
from trigpointd.messages.images import to_frame
from trigpointd.sources.base import BadFrame, Captured, Message

_log = logging.getLogger(__name__)
T = TypeVar("T")
# DepthAI's names of pixel formats and lens models, and ROS's, which the rest of the daemon uses.
_ENCODINGS = {
    "GRAY8": "mono8",
    "RAW8": "mono8",
    "NV12": "nv12",
    "NV21": "nv21",
    "BGR888i": "bgr8",
    "RGB888i": "rgb8",
}
_LENSES = {"Perspective": "rational_polynomial", "Fisheye": "fisheye"}
_QUEUE_SIZE = 4  # frames that wait for a busy event loop


class _CameraLostError(Exception):
    """The camera is not there, or no longer; the text says why."""


class DepthaiSource:
    """One camera of an OAK device; where it is lost, it is looked for until it is back.

    Frames are stamped with the middle of their exposure, which DepthAI gives in the host's
    monotonic clock, as `WallClock` turns it into the system's time. Their intrinsics are those
    that come with each of them, of the size and crop it has. DepthAI is called from one thread
    alone, except to close the queue that this thread waits for.

    Parameters
    ----------
    config : DepthaiConfig
        Which camera, and how it takes pictures.
    open_pipeline : callable, optional
        Makes the pipeline, not yet started, and its queue of frames.
    backoff : Backoff, optional
        The delays between tries.
    """

    live = True

    def __init__(
        self,
        config: DepthaiConfig,
        *,
        open_pipeline: Callable[[DepthaiConfig], tuple[Any, Any]] | None = None,
        backoff: Backoff | None = None,
    ) -> None:
        self._dai = _import_depthai()
        self._config = config
        self._open_pipeline = open_pipeline or open_camera
        self._backoff = backoff or Backoff()
        self._clock = WallClock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="depthai")
        self._pipeline: Any = None
        self._queue: Any = None
        self._calibration: Message | None = None
        self._camera: Camera | None = None
        self._problem: str | None = None
        self._sequence: int | None = None
        self._num_missed = 0

    def describe(self) -> str:
        """Take a frame and say what it is."""
        try:
            self._start()
            frame = self._next().frame
        except _CameraLostError as error:
            raise SourceError(str(error)) from error
        finally:
            self._stop()
        if isinstance(frame, BadFrame):
            raise SourceError(frame.detail)
        return f"{self._config.socket} gives {frame.camera.width} x {frame.camera.height} px"

    async def frames(self) -> AsyncGenerator[Captured, None]:
        """Yield frames as they come; one that cannot be used is a `BadFrame`.

        Raises
        ------
        SourceError
            Where no other try would help: there is no such socket, or no usable calibration.
        """
        while True:
            try:
                await self._in_thread(self._start)
                while True:
                    captured = await self._in_thread(self._next)
                    self._report("")
                    self._backoff.reset()
                    yield captured
            except _CameraLostError as error:
                self._report(str(error))
            finally:
                await self.close()
            await asyncio.sleep(self._backoff.next_s())

    async def close(self) -> None:
        """Stop the camera, also while its thread waits for a frame."""
        queue = self._queue
        if queue is not None:
            queue.close()
        await self._in_thread(self._stop)

    async def _in_thread(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)

    def _report(self, problem: str) -> None:
        """Say what is wrong with the camera, if anything, where that has changed."""
        if problem == self._problem:
            return
        self._problem = problem
        if problem:
            _log.warning("%s; trying until there are frames", problem)
        else:
            _log.info("frames come from %s", self._config.socket)

    def _start(self) -> None:
        try:
            self._pipeline, self._queue = self._open_pipeline(self._config)
            self._pipeline.start()
        except RuntimeError as error:
            raise _CameraLostError(f"the camera cannot be started: {_one_line(error)}") from error
        self._sequence = None

    def _next(self) -> Captured:
        timeout_s = self._config.timeout_s
        try:
            image = self._queue.get(timedelta(seconds=timeout_s))
        except (RuntimeError, self._dai.MessageQueue.QueueException) as error:
            raise _CameraLostError("the camera was disconnected") from error
        if image is None:
            raise _CameraLostError(f"no frame from the camera in {timeout_s:g} s")
        self._count(image.getSequenceNum())
        return self._capture(image)

    def _count(self, sequence: int) -> None:
        if self._sequence is not None and sequence > self._sequence + 1:
            missed = sequence - self._sequence - 1
            self._num_missed += missed
            _log.debug("%d frames missed before frame %d", missed, sequence)
        self._sequence = sequence

    def _capture(self, image: Any) -> Captured:
        arrival_ns, sequence = time.time_ns(), image.getSequenceNum()
        name = f"{self._config.socket}#{sequence}"
        middle = image.getTimestamp(self._dai.CameraExposureOffset.MIDDLE)
        time_ns = self._clock.time_ns(middle // timedelta(microseconds=1) * 1000)
        camera = _camera(image.getTransformation())
        if self._calibration is None or camera != self._camera:
            self._camera = camera
            self._calibration = calibration_message(camera, arrival_ns)
        parsed = Image(
            time_ns,
            "camera",
            image.getData().tobytes(),
            _ENCODINGS.get(image.getType().name, image.getType().name),
            image.getWidth(),
            image.getHeight(),
            image.getStride(),
        )
        try:
            frame = to_frame(parsed, camera, time_ns, name)
        except SourceError as error:
            bad = BadFrame(arrival_ns, name, str(error))
            return Captured(bad, arrival_ns, num_missed=self._num_missed)
        message = image_message(gray_image(frame), arrival_ns, sequence)
        return Captured(frame, arrival_ns, message, self._calibration, self._num_missed)

    def _stop(self) -> None:
        pipeline, self._pipeline, self._queue = self._pipeline, None, None
        if pipeline is None:
            return
        device = pipeline.getDefaultDevice()
        try:
            pipeline.stop()
            pipeline.wait()  # without it the process may crash at its exit
            if device is not None:
                device.close()
        except RuntimeError as error:
            _log.debug("the camera did not stop in order: %s", _one_line(error))


def open_camera(config: DepthaiConfig) -> tuple[Any, Any]:
    """Open a device and make the pipeline of one of its cameras, and the queue of its frames.

    The pixel format is DepthAI's choice for the sensor.
    """
    dai = _import_depthai()
    # Looking takes half a second; opening a device that is not there, twelve.
    device = dai.Device(choose_device(dai.Device.getAllAvailableDevices(), config.device))
    try:
        return _make_pipeline(dai, device, config)
    except BaseException:
        device.close()
        raise


def _make_pipeline(dai: Any, device: Any, config: DepthaiConfig) -> tuple[Any, Any]:
    device.setMaxReconnectionAttempts(0)  # the source tries again by itself
    socket = getattr(dai.CameraBoardSocket, config.socket)
    sensors = {sensor.socket: sensor for sensor in device.getConnectedCameraFeatures()}
    if socket not in sensors:
        names = ", ".join(sorted(other.name for other in sensors)) or "none"
        raise SourceError(f"the device has no camera {config.socket}; it has {names}")
    pipeline = dai.Pipeline(device)
    camera = pipeline.create(dai.node.Camera).build(socket)
    set_exposure(camera.initialControl, config)
    if sensors[socket].hasAutofocus:
        # The intrinsics hold for the lens where it was when they were measured.
        lens_position = device.readCalibration().getLensPosition(socket)
        camera.initialControl.setManualFocus(lens_position)
    output = camera.requestOutput((config.width, config.height), fps=config.fps)
    return pipeline, output.createOutputQueue(maxSize=_QUEUE_SIZE, blocking=False)


def choose_device(found: Sequence[Any], wanted: str | None) -> Any:
    """Return the device of an id, USB port or IP address, or the first."""
    for info in found:
        if wanted in (None, info.deviceId, info.name):
            return info
    if wanted is None:
        raise _CameraLostError("no OAK camera is connected, or none that is free")
    names = ", ".join(f"{info.deviceId} ({info.name})" for info in found) or "none"
    raise _CameraLostError(f"camera {wanted} is not connected, or not free; there are: {names}")


def set_exposure(control: Any, config: DepthaiConfig) -> None:
    """Fix the exposure, or limit the automatic one, as far as the settings say so."""
    if config.exposure_ms is not None:
        control.setManualExposure(timedelta(milliseconds=config.exposure_ms), config.iso)
    elif config.max_exposure_ms is not None:
        control.setAutoExposureLimit(timedelta(milliseconds=config.max_exposure_ms))


def _camera(transformation: Any) -> Camera:
    """Return the intrinsics of a frame, of its size, crop and scale."""
    if np.array_equal(transformation.getSourceIntrinsicMatrix(), np.eye(3)):
        raise SourceError(
            "the camera was never calibrated: its frames have no intrinsics; calibrate it with "
            "Luxonis's tools, which store the result in the device"
        )
    model = transformation.getDistortionModel().name
    width, height = transformation.getSize()
    return Calibration(
        frame_id="",
        width=width,
        height=height,
        distortion_model=_LENSES.get(model, model),
        D=transformation.getDistortionCoefficients(),
        K=np.ravel(transformation.getIntrinsicMatrix()).tolist(),
        P=(),
    ).camera()


def _import_depthai() -> Any:
    # It would take over signals that Python handles, such as that of a file that is too large.
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    try:
        import depthai
    except ImportError as error:
        raise ConfigError(
            f"OAK cameras need the package depthai ({error}); install it with "
            "pip install 'trigpoint[oak]'"
        ) from error
    return depthai


def _one_line(error: RuntimeError) -> str:
    return " ".join(str(error).split())
