"""The daemon's settings: one strict TOML file."""

from __future__ import annotations

import dataclasses
import difflib
import json
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

import numpy as np
from pydantic import (
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from trigpoint.camera import MAX_SIDE_PX, Camera
from trigpoint.errors import ConfigError
from trigpoint.models.features import Profile
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
S = TypeVar("S", bound="Section")


class Section(BaseModel):
    """A table of the file; a key it does not know is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class McapConfig(Section):
    """Frames come from a recording."""

    type: Literal["mcap"]
    path: Path
    image_topic: str | None = None  # needed where the recording has several
    rate: Annotated[float, Field(gt=0)] | None = None  # of the recorded pace; without: at once
    start_s: Annotated[float, Field(ge=0)] = 0.0  # since the first image
    end_s: Annotated[float, Field(gt=0)] | None = None
    start_time: AwareDatetime | None = None  # of arrival; what is given of the four all holds
    end_time: AwareDatetime | None = None
    loop: bool = False  # begin again at the end; times go on


def _parse_camera(text: object) -> Camera:
    if not isinstance(text, str):
        raise ValueError("must be a text, 'MODEL width height params...'")  # noqa: TRY004
    try:
        return Camera.from_text(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error


CameraText = Annotated[Camera, PlainValidator(_parse_camera), PlainSerializer(Camera.to_text)]


class V4l2Config(Section):
    """Frames come from a camera that Linux knows as a video device."""

    type: Literal["v4l2"]
    device: Path
    camera: CameraText  # intrinsics; their size is asked for
    format: Literal["YUYV", "GREY", "NV12", "MJPG"] = "YUYV"
    fps: Annotated[float, Field(gt=0, le=1000)] | None = None  # without: the driver's choice
    exposure_ms: Annotated[float, Field(gt=0, le=10_000)] | None = None  # fixed; else automatic
    gain: Annotated[int, Field(ge=0, lt=2**31)] | None = None  # fixed, in the driver's unit
    keep_rate: bool = True  # in the dark too, where the exposure is automatic
    timeout_s: Annotated[float, Field(gt=0)] = 5.0  # without a usable frame: opened again
    allow_repeats: bool = False  # pictures that are the same to the byte, as simulations give


class DepthaiConfig(Section):
    """Frames come from an OAK camera; it needs the extra `oak`."""

    type: Literal["depthai"]
    device: str | None = None  # id, USB port or IP address; without: the first found
    socket: Annotated[str, Field(pattern=r"^CAM_[A-J]$")] = "CAM_A"
    width: Annotated[int, Field(ge=1, le=MAX_SIDE_PX)] = 640
    height: Annotated[int, Field(ge=1, le=MAX_SIDE_PX)] = 480
    fps: Annotated[float, Field(gt=0)] = 30.0
    max_exposure_ms: Annotated[float, Field(gt=0)] | None = None  # of the automatic exposure
    exposure_ms: Annotated[float, Field(gt=0)] | None = None  # fixed, and so is `iso`
    iso: Annotated[int, Field(gt=0)] | None = None
    timeout_s: Annotated[float, Field(gt=0)] = 5.0  # without a frame the camera counts as lost

    @model_validator(mode="after")
    def _one_exposure(self) -> Self:
        if (self.exposure_ms is None) != (self.iso is None):
            raise ValueError("a fixed exposure needs both exposure_ms and iso")
        if self.exposure_ms is not None and self.max_exposure_ms is not None:
            raise ValueError("max_exposure_ms limits the automatic exposure; omit exposure_ms")
        return self


SourceConfig = Annotated[McapConfig | V4l2Config | DepthaiConfig, Field(discriminator="type")]
_SOURCES: dict[int | str, type[Section]] = {
    "mcap": McapConfig,
    "v4l2": V4l2Config,
    "depthai": DepthaiConfig,
}


class CameraConfig(Section):
    """Where the camera sits on the body."""

    position_m: Vector3 = (0.0, 0.0, 0.0)  # in the body's frame
    rotation_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)  # body_from_camera

    @field_validator("rotation_wxyz")
    @classmethod
    def _unit(cls, wxyz: Quaternion) -> Quaternion:
        if abs(np.linalg.norm(wxyz) - 1) > 0.01:
            raise ValueError("must be a unit quaternion, w first")
        return wxyz

    @property
    def body_from_camera(self) -> Rigid3:
        """The extrinsics; in a camera's frame x is right, y down, z ahead."""
        return Rigid3.from_quaternion(self.rotation_wxyz, self.position_m)


class ModelConfig(Section):
    """Which networks, and how they run."""

    network: Profile | Path = "base"
    retrieval: Path | None = None  # for the global descriptor; needed where `network` gives none
    matcher: Path | None = None  # mutual nearest neighbours by default
    num_threads: Annotated[int, Field(ge=1, le=64)] = 2  # of each

    @field_validator("network", mode="before")
    @classmethod
    def _named(cls, network: object) -> object:
        if not isinstance(network, str | Path):
            raise ValueError("must be 'tiny', 'base', 'large' or a file")  # noqa: TRY004
        return network


class TlsConfig(Section):
    """Encryption, and who may do what, by the common names in their certificates."""

    ca: Path  # PEM, as the others; who signed the certificates of all that take part
    certificate: Path
    private_key: Path
    readers: tuple[str, ...] = ()  # may receive poses and status
    operators: tuple[str, ...] = ()  # may also send requests


class RequestsConfig(Section):
    """What peers may ask the daemon for."""

    allow: tuple[Literal["localize", "map", "change_map", "config"], ...] = (
        "localize",
        "map",
        "config",
    )
    cameras: dict[str, CameraText] = {}  # that requests may name
    max_payload_bytes: Annotated[int, Field(ge=1, le=2**28)] = 4 * 2**20
    max_side_px: Annotated[int, Field(ge=1, le=MAX_SIDE_PX)] = 4096
    max_rate_hz: Annotated[float, Field(gt=0)] = 5.0  # of each kind
    max_waiting: Annotated[int, Field(ge=1, le=1000)] = 4


class ZenohConfig(Section):
    """How to reach subscribers, and who may do what."""

    mode: Literal["peer", "client"] = "peer"
    listen: tuple[str, ...] = ()  # endpoints, such as "tcp/127.0.0.1:7447"
    connect: tuple[str, ...] = ()
    multicast_scouting: bool = True
    wait_for_subscriber_s: Annotated[float, Field(ge=0)] = 0.0  # before the first frame
    requests: RequestsConfig = RequestsConfig()
    tls: TlsConfig | None = None

    @model_validator(mode="after")
    def _all_encrypted(self) -> Self:
        plain = [e for e in (*self.listen, *self.connect) if not e.startswith("tls/")]
        if self.tls is not None and plain:
            raise ValueError(f"with [zenoh.tls], {plain[0]!r} must begin with tls/")
        return self


class LogConfig(Section):
    """The MCAP log."""

    path: Path  # in the file's name %Y, %m, %d, %H, %M, %S stand for the time of its start
    frames: bool = True  # input images too, so that the log can be replayed
    visuals: bool = True  # keypoints, anchors, path, for Foxglove
    overwrite: bool = False
    max_part_mb: Annotated[float, Field(ge=1)] | None = None  # then comes another part; off
    max_part_s: Annotated[float, Field(ge=1)] | None = None  # the same
    min_free_mb: Annotated[float, Field(ge=0)] = 0.0  # on the disk; old logs are deleted for it
    flush_s: Annotated[float, Field(gt=0)] = 1.0  # what a loss of power costs

    @field_validator("path")
    @classmethod
    def _named_by_time(cls, path: Path) -> Path:
        if any("%" in part for part in path.parts[:-1]):
            raise ValueError("the time may stand in the file's name, not in a folder's")
        if re.search("%(?![YmdHMS])", path.name):
            raise ValueError("the file's name takes %Y, %m, %d, %H, %M and %S")
        return path

    @field_validator("max_part_mb", "max_part_s")
    @classmethod
    def _not_overwritten(cls, limit: float | None, info: ValidationInfo) -> float | None:
        if limit is not None and info.data.get("overwrite"):
            raise ValueError("parts have numbers of their own; leave out overwrite")
        return limit

    @property
    def rotates(self) -> bool:
        """Whether the log is written in parts."""
        return self.max_part_mb is not None or self.max_part_s is not None


class FoxgloveConfig(Section):
    """A live view; it needs the extra `foxglove`."""

    host: str = "127.0.0.1"  # that viewers connect to
    port: Annotated[int, Field(ge=1, le=65_535)] = 8765


class Config(Section):
    """All settings of `trigpointd run`."""

    map: Path
    base_key: Annotated[str, Field(pattern=r"^[^/*$?#]+(/[^/*$?#]+)*$")] = "trigpoint/device"
    map_frame: str = "map"  # frame_id of the poses
    source: SourceConfig
    camera: CameraConfig = CameraConfig()
    model: ModelConfig = ModelConfig()
    localizer: LocalizerOptions = LocalizerOptions()
    zenoh: ZenohConfig | None = None  # without the table nothing is published
    log: LogConfig | None = None
    foxglove: FoxgloveConfig | None = None  # without the table there is no live view


def load_config(path: Path) -> Config:
    """Read and check the file; relative paths in it are relative to its folder."""
    try:
        tables = tomllib.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path} is not TOML: {error}") from error
    try:
        # As JSON, of whose types TOML's are, so that a strict check still takes text for a path.
        config = Config.model_validate_json(json.dumps(tables, default=str), strict=True)
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error)}") from error
    except ConfigError as error:  # from LocalizerOptions
        raise ConfigError(f"{path}: localizer: {error}") from error
    return _resolve(config, path.parent)


def _resolve(section: S, folder: Path) -> S:
    """Make the paths of a section, and of those within, relative to a folder."""
    changes: dict[str, Any] = {}
    for name, value in section:
        if isinstance(value, Path):
            if "\0" in str(value):
                raise ConfigError(f"{name!r} names no file: {str(value)!r}")
            changes[name] = folder / value
        elif isinstance(value, Section):
            changes[name] = _resolve(value, folder)
    return section.model_copy(update=changes)


def explain(error: ValidationError) -> str:
    """Put one thing that is wrong in one line; for an unknown key, name the nearest one."""
    unknown = ("extra_forbidden", "unexpected_keyword_argument")
    # A mistyped key is both unknown and missing: the former says more.
    first = min(error.errors(), key=lambda item: item["type"] not in unknown)
    loc = first["loc"]
    # After `source` pydantic puts the type that chose among its tables.
    where = ".".join(str(part) for i, part in enumerate(loc) if (i, loc[0]) != (1, "source"))
    if first["type"] in unknown:
        known = _keys(loc[:-1])
        near = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=0.0)
        return f"unknown key {where!r}; did you mean {near[0]!r}?"
    if first["type"] == "union_tag_not_found":
        near = difflib.get_close_matches("type", first["input"], n=1)
        mistyped = f"unknown key '{where}.{near[0]}'; did you mean 'type'?" if near else ""
        return mistyped or f"'{where}.type' is missing"
    if first["type"] == "union_tag_invalid":
        context = first["ctx"]
        return f"'{where}.type': must be one of {context['expected_tags']}, not {context['tag']!r}"
    if first["type"] == "missing":
        return f"{where!r} is missing"
    return f"{where!r}: {first['msg']} (it is {first['input']!r})"


def _keys(loc: tuple[int | str, ...]) -> list[str]:
    """List the keys of the table at a place in the file."""
    section: Any = Config
    for part in loc:
        if part in _SOURCES:
            section = _SOURCES[part]
            continue
        annotation = section.model_fields[part].annotation
        section = next(
            kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type)
        )
    if dataclasses.is_dataclass(section):
        return [field.name for field in dataclasses.fields(section)]
    return list(section.model_fields)
