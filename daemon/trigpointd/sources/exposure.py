"""Exposure and gain of a V4L2 camera."""

from __future__ import annotations

import contextlib
import errno

from trigpoint.errors import ConfigError
from trigpointd.config import V4l2Config
from trigpointd.sources import videodev2 as v4l2
from trigpointd.sources.video_device import VideoDevice

_REFUSALS = (errno.EINVAL, errno.ERANGE, errno.EACCES, errno.EPERM)


def set_exposure(device: VideoDevice, config: V4l2Config) -> None:
    """Fix exposure and gain where the settings say so, else leave them to the camera's automatics.

    A camera keeps what another program has set, also whether they are automatic. A setting that the
    camera has no control for, or does not take, is a ConfigError.
    """
    exposure_ms, gain = config.exposure_ms, config.gain
    _try(device, v4l2.CID_EXPOSURE_AUTO, None if exposure_ms is None else v4l2.EXPOSURE_MANUAL)
    _try(device, v4l2.CID_EXPOSURE_AUTO_PRIORITY, int(not config.keep_rate))
    _try(device, v4l2.CID_AUTOGAIN, None if gain is None else 0)
    if exposure_ms is not None:
        _set(device, v4l2.CID_EXPOSURE_ABSOLUTE, "exposure_ms", exposure_ms, counts_per_unit=10)
    if gain is not None:
        _set(device, v4l2.CID_GAIN, "gain", gain)


def _try(device: VideoDevice, number: int, value: int | None) -> None:
    """Set a control, to its default with None, if the camera has it and takes that."""
    with contextlib.suppress(OSError):
        control = device.control(number)
        if control is not None:
            device.set_control(number, control.default_value if value is None else value)


def _set(
    device: VideoDevice, number: int, key: str, value: float, counts_per_unit: int = 1
) -> None:
    control = device.control(number)
    if control is None:
        raise ConfigError(
            f"it has no control for source.{key}; leave that out (`v4l2-ctl --list-ctrls` lists "
            "what it has)"
        )
    count = round(value * counts_per_unit)
    if not control.minimum <= count <= control.maximum:
        low, high = control.minimum / counts_per_unit, control.maximum / counts_per_unit
        raise ConfigError(f"it takes a source.{key} of {low:g} to {high:g}, not of {value:g}")
    try:
        device.set_control(number, count)
    except OSError as error:
        if error.errno not in _REFUSALS:
            raise
        raise ConfigError(
            f"it does not take source.{key} = {value:g} ({error.strerror}); leave that out"
        ) from error
