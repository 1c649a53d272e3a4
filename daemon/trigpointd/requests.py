"""What peers may ask the daemon for, and what they get: JSON, or an error of one line."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import date
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.database.writer import MapWriter
from trigpoint.errors import RequestError, TrigpointError
from trigpoint.frame import Frame, Prior, Session, describe
from trigpoint.images import decode_gray, read_size
from trigpoint.rigid import Rigid3
from trigpointd.config import Config, RequestsConfig
from trigpointd.pipeline import Pipeline

_FILES = ("image/jpeg", "image/png")
_GRAY = "application/octet-stream"
# Beyond these no camera is, and a computation with its numbers may overflow.
_FOCAL_RATIOS = (0.05, 50.0)  # focal length by the image's longer side
_MAX_DISTORTION = 100.0  # of a coefficient
_MAX_COORDINATE = 1e8  # in the map's unit; Earth's radius is 6.4e6 m

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Request:
    """What a peer asks for: the end of the key, the selector's parameters, the payload."""

    kind: str
    parameters: Mapping[str, str]
    encoding: str = ""
    payload: bytes = field(default=b"", repr=False)


@dataclass(frozen=True)
class Answer:
    """JSON, or if `is_error` a line that says what is wrong."""

    payload: bytes
    is_error: bool = False


class Responder:
    """Answers requests, one at a time and not while a frame is localized."""

    def __init__(self, config: Config, limits: RequestsConfig, pipeline: Pipeline) -> None:
        self._config = config
        self._limits = limits
        self._pipeline = pipeline
        self._map_actions: dict[str, Callable[[Request], dict[str, Any]]] = {
            "info": self._info,
            "reload": self._reload,
            "add": self._add,
            "remove": self._remove,
        }

    def use(self, config: Config, pipeline: Pipeline) -> None:
        """Answer from another pipeline from now on; not while a request is answered."""
        self._config, self._pipeline = config, pipeline

    def answer(self, request: Request) -> Answer:
        """Do what is asked for; whatever goes wrong with it is the answer."""
        try:
            if request.kind not in self._limits.allow:
                raise RequestError(  # noqa: TRY301
                    f"requests of the kind {request.kind!r} are not allowed; "
                    f"zenoh.requests.allow has {', '.join(self._limits.allow) or 'none'}"
                )
            return Answer(json.dumps(self._do(request)).encode())
        except TrigpointError as error:
            return Answer(str(error).encode(), is_error=True)
        except Exception as error:  # what comes from outside must not end the daemon
            _log.exception("a request of the kind %r failed", request.kind)
            text = f"the request failed: {type(error).__name__}: {error}"
            return Answer(" ".join(text.split()).encode(), is_error=True)

    def _do(self, request: Request) -> dict[str, Any]:
        if request.kind == "localize":
            return self._localize(request)
        if request.kind == "config":
            _parse(request)
            return self._config.model_dump(mode="json")
        action = request.parameters.get("action", "info")
        if action not in self._map_actions:
            raise RequestError(
                f"action {action!r} is not known; use one of {', '.join(self._map_actions)}"
            )
        return self._map_actions[action](request)

    def _localize(self, request: Request) -> dict[str, Any]:
        (camera,) = _parse(request, "camera", optional=("position", "radius_m"))
        prior = _parse_prior(request.parameters)
        result = self._pipeline.localize(self._frame(request, camera, "request"), prior)
        return {**describe(result), "map_generation": self._pipeline.reader.generation}

    def _info(self, request: Request) -> dict[str, Any]:
        _parse(request, optional=("action",))
        reader = self._pipeline.reader
        noise = reader.pose_noise
        return {
            "generation": reader.generation,
            "num_images": len(reader),
            "model": reader.model.name,
            "sessions": [str(session) for session in reader.sessions],
            "pose_noise": None if noise is None else asdict(noise),
        }

    def _reload(self, request: Request) -> dict[str, Any]:
        _parse(request, "action")
        return self._refreshed()

    def _add(self, request: Request) -> dict[str, Any]:
        self._require_changes()
        _, name, camera, pose = _parse(
            request, "action", "name", "camera", "cam_from_world", optional=("session", "date")
        )
        cam_from_world, session = _parse_pose(pose), _parse_session(request.parameters)
        frame = self._frame(request, camera, name)
        localizer = self._pipeline.localizer
        features = localizer.model.extract(frame.image, localizer.options.max_keypoints)
        with MapWriter.open(self._config.map, localizer.model.identity) as writer:
            writer.add(name, frame.camera, cam_from_world, features, session)
        return {**self._refreshed(), "num_keypoints": len(features)}

    def _remove(self, request: Request) -> dict[str, Any]:
        self._require_changes()
        _, name = _parse(request, "action", "name")
        with MapWriter.open(self._config.map, self._pipeline.reader.model) as writer:
            writer.remove(name)
        return self._refreshed()

    def _refreshed(self) -> dict[str, Any]:
        self._pipeline.reader.refresh()
        return self._info(Request("map", {}))

    def _require_changes(self) -> None:
        if "change_map" not in self._limits.allow:
            raise RequestError(
                "the map may not be changed; add 'change_map' to zenoh.requests.allow"
            )

    def _frame(self, request: Request, camera: str, name: str) -> Frame:
        known = self._camera(camera)
        return Frame(self._image(request, known), known, name=name)

    def _camera(self, text: str) -> Camera:
        camera = self._limits.cameras.get(text)
        if camera is None:
            if not any(character.isspace() for character in text):
                known = ", ".join(self._limits.cameras) or "none"
                raise RequestError(
                    f"camera {text!r} is not known; zenoh.requests.cameras has {known}, or write "
                    "'MODEL width height params...'"
                )
            camera = Camera.from_text(text)
            _require_plausible(camera)
        if max(camera.width, camera.height) > self._limits.max_side_px:
            raise RequestError(
                f"images of {camera.width} x {camera.height} px are too large; at most "
                f"{self._limits.max_side_px} px a side are accepted"
            )
        return camera

    def _image(self, request: Request, camera: Camera) -> NDArray[np.uint8]:
        size = camera.width, camera.height
        if request.encoding == _GRAY:
            if len(request.payload) != size[0] * size[1]:
                raise RequestError(
                    f"{len(request.payload)} bytes are not the {size[0]} x {size[1]} gray levels "
                    "of the camera"
                )
            return np.frombuffer(request.payload, np.uint8).reshape(size[1], size[0])
        if request.encoding not in _FILES:
            raise RequestError(
                f"encoding {request.encoding!r} is not supported; send {', '.join(_FILES)}, or "
                f"{_GRAY} for gray levels row by row"
            )
        if (found := read_size(request.payload)) != size:  # before memory is spent on it
            raise RequestError(
                f"the image is {found[0]} x {found[1]} px, but its camera's calibration is for "
                f"{size[0]} x {size[1]} px"
            )
        return decode_gray(request.payload)


def _parse(request: Request, *names: str, optional: tuple[str, ...] = ()) -> list[str]:
    """Return the parameters of these names; one more or less is an error."""
    known = (*names, *optional)
    for name in request.parameters:
        if name not in known and not name.startswith("_"):  # those are Zenoh's own
            raise RequestError(f"parameter {name!r} is not known; use {', '.join(known) or 'none'}")
    for name in names:
        if not request.parameters.get(name):
            raise RequestError(f"parameter {name!r} is missing")
    return [request.parameters[name] for name in names]


def _parse_pose(text: str) -> Rigid3:
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != 7:
        raise RequestError(f"cam_from_world is {text!r}; write 'qw qx qy qz tx ty tz'")
    quaternion, t = numbers[:4], numbers[4:]
    if not abs(np.linalg.norm(quaternion) - 1) < 0.01:
        raise RequestError(f"cam_from_world is {text!r}; its quaternion must have length 1")
    if not np.abs(t).max() < _MAX_COORDINATE:
        raise RequestError(f"cam_from_world is {text!r}; its translation is too far away")
    return Rigid3.from_quaternion(quaternion, t)


def _parse_session(parameters: Mapping[str, str]) -> Session | None:
    name, day = parameters.get("session"), parameters.get("date")
    if name is None and day is None:
        return None
    try:
        return Session(name or "", None if day is None else date.fromisoformat(day))
    except ValueError:
        raise RequestError(f"date is {day!r}; write 2026-01-31") from None


def _parse_prior(parameters: Mapping[str, str]) -> Prior | None:
    position, radius = (parameters.get(name) for name in ("position", "radius_m"))
    if position is None and radius is None:
        return None
    try:
        x, y, z = (float(number) for number in (position or "").split(","))
        return Prior((x, y, z), float(radius or ""))
    except ValueError:
        raise RequestError(
            f"position is {position!r} and radius_m {radius!r}; write both, 'x,y,z' and a number"
        ) from None


def _require_plausible(camera: Camera) -> None:
    ratios = np.divide(camera.focals_px, max(camera.width, camera.height))
    cx, cy = camera.K[:2, 2]
    if not (
        (_FOCAL_RATIOS[0] < ratios).all()
        and (ratios < _FOCAL_RATIOS[1]).all()
        and 0 <= cx <= camera.width
        and 0 <= cy <= camera.height
        and np.abs(camera.distortion).max() < _MAX_DISTORTION
    ):
        raise RequestError(f"camera {camera.to_text()!r} is none that there can be")
