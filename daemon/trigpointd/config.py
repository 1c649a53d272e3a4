"""The daemon's settings: one strict TOML file."""

from __future__ import annotations

import dataclasses
import difflib
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
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


class SourceConfig(Section):
    """Where frames come from."""

    type: Literal["mcap"]
    path: Path
    image_topic: str | None = None  # needed where the recording has several
    rate: Annotated[float, Field(gt=0)] | None = None  # of the recorded pace; without: at once


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


def _parse_camera(text: object) -> Camera:
    if not isinstance(text, str):
        raise ValueError("must be a text, 'MODEL width height params...'")  # noqa: TRY004
    try:
        return Camera.from_text(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error


CameraText = Annotated[Camera, PlainValidator(_parse_camera), PlainSerializer(Camera.to_text)]


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

    path: Path  # strftime's %Y, %m, %d, %H, %M, %S stand for the time of the start
    frames: bool = True  # input images too, so that the log can be replayed
    overwrite: bool = False


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
        raise ConfigError(f"{path}: {_explain(error)}") from error
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


def _explain(error: ValidationError) -> str:
    """Put one thing that is wrong in one line; for an unknown key, name the nearest one."""
    unknown = ("extra_forbidden", "unexpected_keyword_argument")
    # A mistyped key is both unknown and missing: the former says more.
    first = min(error.errors(), key=lambda item: item["type"] not in unknown)
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] in unknown:
        known = _keys(first["loc"][:-1])
        near = difflib.get_close_matches(str(first["loc"][-1]), known, n=1, cutoff=0.0)
        return f"unknown key {where!r}; did you mean {near[0]!r}?"
    if first["type"] == "missing":
        return f"{where!r} is missing"
    return f"{where!r}: {first['msg']} (it is {first['input']!r})"


def _keys(loc: tuple[int | str, ...]) -> list[str]:
    """List the keys of the table at a place in the file."""
    section: Any = Config
    for part in loc:
        annotation = section.model_fields[part].annotation
        section = next(
            kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type)
        )
    if dataclasses.is_dataclass(section):
        return [field.name for field in dataclasses.fields(section)]
    return list(section.model_fields)
