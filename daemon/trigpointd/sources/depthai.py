"""Frames from an OAK camera, through DepthAI."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import os
import threading
import time
from collections.abc import AsyncGenerator, Callable, Generator, Sequence
from concurrent.futures import Future
from datetime import timedelta
from typing import Any

import numpy as np

from trigpoint.camera import Camera
from trigpoint.camera_messages import Calibration, Image
from trigpoint.errors import ConfigError, SourceError
from trigpointd.clock import WallClock
from trigpointd.config import DepthaiConfig
from trigpointd.messages.foxglove import calibration_message, gray_image, image_message
from trigpointd.messages.images import to_frame
from trigpointd.sources.base import BadFrame, Captured, Message
from trigpointd.sources.lookahead import read_ahead

_log = logging.getLogger(__name__)
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
_OPENER = "depthai-opener"
_QUEUE_SIZE = 4  # frames that wait for a busy event loop


class DepthaiSource:
    """One camera of an OAK device, which is opened with each stream of frames.

    Frames are stamped with the middle of their exposure, which DepthAI gives in the host's
    monotonic clock, as `WallClock` turns it into the system's time. Their intrinsics are those
    that come with each of them, of the size and crop it has.

    Parameters
    ----------
    config : DepthaiConfig
        Which camera, and how it takes pictures.
    open_pipeline : callable, optional
        Makes the pipeline, not yet started, and its queue of frames.
    """

    def __init__(
        self,
        config: DepthaiConfig,
        *,
        open_pipeline: Callable[[DepthaiConfig], tuple[Any, Any]] | None = None,
    ) -> None:
        self.name = f"camera {config.socket}"
        self._dai = _import_depthai()
        self._config = config
        self._open_pipeline = open_pipeline or open_camera
        self._clock = WallClock()
        self._calibration: Message | None = None
        self._camera: Camera | None = None
        self._sequence: int | None = None
        self._num_missed = 0

    def describe(self) -> str:
        """Take a frame and say what it is."""
        with contextlib.closing(self._captures(*self._open())) as captures:
            frame = next(captures).frame
        if isinstance(frame, BadFrame):
            raise SourceError(frame.detail)
        return f"it gives {frame.camera.width} x {frame.camera.height} px"

    async def frames(self) -> AsyncGenerator[Captured, None]:
        """Open the camera and yield frames as they come; one that is of no use is a `BadFrame`.

        Raises
        ------
        SourceError
            Where the camera is lost, or cannot be opened now.
        ConfigError
            Where no other try would help: there is no such socket, or no usable calibration.
        """
        opening: Future[tuple[Any, Any]] = Future()
        opening.set_running_or_notify_cancel()  # it cannot be cancelled
        # Opening may take twelve seconds and cannot be interrupted, only left to itself.
        threading.Thread(target=self._open_into, args=(opening,), name=_OPENER, daemon=True).start()
        try:
            pipeline, queue = await asyncio.wrap_future(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_discard)
            raise
        ahead = read_ahead(self._captures(pipeline, queue), stop=queue.close)
        async with contextlib.aclosing(ahead):
            async for captured in ahead:
                yield captured

    async def close(self) -> None:
        """Nothing is held once `frames` has ended."""

    def _open_into(self, opening: Future[tuple[Any, Any]]) -> None:
        try:
            opening.set_result(self._open())
        except BaseException as error:
            opening.set_exception(error)

    def _open(self) -> tuple[Any, Any]:
        _log.debug("%s: opening %s", self.name, self._config.device or "the first device")
        try:
            return self._open_pipeline(self._config)
        except RuntimeError as error:
            raise SourceError(f"it cannot be opened: {_one_line(error)}") from error

    def _captures(self, pipeline: Any, queue: Any) -> Generator[Captured, None, None]:
        self._sequence = None
        try:
            pipeline.start()
            while True:
                yield self._capture(self._next(queue))
        except RuntimeError as error:
            raise SourceError(f"it failed: {_one_line(error)}") from error
        finally:
            _stop(pipeline)

    def _next(self, queue: Any) -> Any:
        timeout_s = self._config.timeout_s
        try:
            image = queue.get(timedelta(seconds=timeout_s))
        except (RuntimeError, self._dai.MessageQueue.QueueException) as error:
            raise SourceError("it was disconnected") from error
        if image is None:
            raise SourceError(f"no frame in {timeout_s:g} s")
        return image

    def _count(self, sequence: int) -> None:
        if self._sequence is not None and sequence > self._sequence + 1:
            missed = sequence - self._sequence - 1
            self._num_missed += missed
            _log.debug("%d frames missed before frame %d", missed, sequence)
        self._sequence = sequence

    def _capture(self, image: Any) -> Captured:
        arrival_ns, sequence = time.time_ns(), image.getSequenceNum()
        self._count(sequence)
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


def is_opening() -> bool:
    """Whether a thread still opens a camera: Python's own end would then crash the process.

    It did 16 of 36 times, by SIGABRT or SIGSEGV; `os._exit` does not.
    """
    return any(thread.name == _OPENER for thread in threading.enumerate())


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
        raise ConfigError(f"the device has no camera {config.socket}; it has {names}")
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
    """Return the device of an id, USB port or IP address, or the first that was found."""
    for info in found:
        if wanted in (None, info.deviceId, info.name):
            return info
    if wanted is None:
        raise SourceError("no OAK camera is connected, or none that is free")
    if _is_address(wanted):  # looking finds cameras of the same subnet alone
        return _import_depthai().DeviceInfo(wanted)
    names = ", ".join(f"{info.deviceId} ({info.name})" for info in found) or "none"
    raise SourceError(f"device {wanted} is not connected, or not free; there are: {names}")


def _is_address(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)  # DepthAI knows no others
    except ValueError:
        return False
    return True


def set_exposure(control: Any, config: DepthaiConfig) -> None:
    """Fix the exposure, or limit the automatic one, as far as the settings say so."""
    if config.exposure_ms is not None:
        control.setManualExposure(timedelta(milliseconds=config.exposure_ms), config.iso)
    elif config.max_exposure_ms is not None:
        control.setAutoExposureLimit(timedelta(milliseconds=config.max_exposure_ms))


def _discard(opening: Future[tuple[Any, Any]]) -> None:
    """Close a camera that nobody waits for any more."""
    if opening.exception() is None:
        pipeline, _ = opening.result()
        _stop(pipeline)


def _stop(pipeline: Any) -> None:
    device = pipeline.getDefaultDevice()
    try:
        pipeline.stop()
        pipeline.wait()  # without it the process may crash at its exit
        if device is not None:
            device.close()
    except RuntimeError as error:
        _log.debug("the camera did not stop in order: %s", _one_line(error))


def _camera(transformation: Any) -> Camera:
    """Return the intrinsics of a frame, of its size, crop and scale."""
    if np.array_equal(transformation.getSourceIntrinsicMatrix(), np.eye(3)):
        raise ConfigError(
            "the camera was never calibrated: its frames have no intrinsics; calibrate it with "
            "Luxonis's tools, which store the result in the device"
        )
    model = transformation.getDistortionModel().name
    width, height = transformation.getSize()
    try:
        return Calibration(
            frame_id="",
            width=width,
            height=height,
            distortion_model=_LENSES.get(model, model),
            D=transformation.getDistortionCoefficients(),
            K=np.ravel(transformation.getIntrinsicMatrix()).tolist(),
            P=(),
        ).camera()
    except SourceError as error:
        raise ConfigError(str(error)) from error


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
