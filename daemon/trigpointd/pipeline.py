"""From a captured frame to what is published of it; no sockets, no tasks, no waiting."""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError, DatabaseError, ModelError
from trigpoint.frame import Failed, Frame, Localized, Prior, Result, describe, summarize
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import load_matcher
from trigpoint.rigid import Rigid3
from trigpointd.config import Config
from trigpointd.messages.cdr import encode_pose
from trigpointd.messages.pose import body_pose
from trigpointd.sources.base import BadFrame, Captured

Report = Callable[[Captured], Mapping[str, object]]

_log = logging.getLogger(__name__)
_MAX_REPORTED = 100  # of errors that differ from frame to frame


@dataclass(frozen=True, eq=False)
class Output:
    """What sinks get for each frame.

    `pose` is a PoseWithCovarianceStamped of world_from_body in CDR, None unless localized; `status`
    is a JSON object, one for every frame; `outcome` is the reason where there is no pose.
    """

    captured: Captured
    result: Result | Failed
    pose: bytes | None
    status: bytes

    @property
    def outcome(self) -> str:
        """In a word, what came of the frame."""
        return summarize(self.result)

    @property
    def time_ns(self) -> int:
        """Capture time."""
        return self.captured.frame.time_ns


class Pipeline:
    """Localizes captured frames and writes the messages about them."""

    def __init__(
        self, localizer: Localizer, reader: MapReader, body_from_camera: Rigid3, map_frame: str
    ) -> None:
        self.localizer = localizer
        self.reader = reader
        self.map_problem = ""  # why the map on disk cannot be taken up
        self._reported: set[str] = set()  # what went wrong with frames, each said once
        self._body_from_camera = body_from_camera
        self._map_frame = map_frame

    def process(self, captured: Captured, report: Report = lambda _: {}) -> Output:
        """Localize one frame; `report` is asked at the end for what else its status says."""
        start_s = time.perf_counter()
        frame = captured.frame
        result = self.localize(frame)
        pose = None
        if isinstance(result, Localized):
            world_from_body, covariance = body_pose(
                result.cam_from_world, result.covariance, self._body_from_camera
            )
            pose = encode_pose(frame.time_ns, self._map_frame, world_from_body, covariance)
        status = {
            "time_ns": frame.time_ns,
            "frame": frame.name,
            **describe(result),
            "latency_ms": round((time.perf_counter() - start_s) * 1e3, 3),
            "num_missed": captured.num_missed,
            "map_generation": self.reader.generation,
            **report(captured),
        }
        return Output(captured, result, pose, json.dumps(status).encode())

    def localize(self, frame: Frame | BadFrame, prior: Prior | None = None) -> Result | Failed:
        """Localize one frame in the map as it is now."""
        self._refresh_map()
        return self._localize(frame, prior)

    def _refresh_map(self) -> None:
        """Take up what was added to the map; where that cannot be used, keep what there was."""
        problem = ""
        try:
            is_new = self.reader.refresh()
        except DatabaseError as error:
            is_new, problem = False, str(error)
        if problem and problem != self.map_problem:
            _log.error("%s; going on with the map as it was, as far as it can be read", problem)
        elif is_new or (self.map_problem and not problem):
            _log.info("the map is now of generation %d", self.reader.generation)
            self._look_for_sessions()
        self.map_problem = problem

    def _look_for_sessions(self) -> None:
        try:
            self.localizer.check_sessions()
        except ConfigError as error:
            self._report(f"{error}; going on without it")

    def _localize(self, frame: Frame | BadFrame, prior: Prior | None) -> Result | Failed:
        if isinstance(frame, BadFrame):
            return Failed(frame.reason, frame.detail)
        try:
            return self.localizer.localize(frame, prior)
        # A damaged image of the map, a network that fails on this frame: others may do.
        except DatabaseError as error:
            return self._failed("BAD_MAP", str(error))
        except ModelError as error:
            return self._failed("BAD_NETWORK", str(error))
        except Exception as error:  # nothing that a camera shows may end the daemon
            text = " ".join(f"{type(error).__name__}: {error}".split())
            return self._failed("INTERNAL_ERROR", text, error)

    def _failed(self, reason: str, detail: str, unexpected: Exception | None = None) -> Failed:
        self._report(detail, unexpected)
        return Failed(reason, detail)

    def _report(self, problem: str, unexpected: Exception | None = None) -> None:
        """Say once what is wrong."""
        if problem not in self._reported and len(self._reported) < _MAX_REPORTED:
            self._reported.add(problem)
            _log.error("%s", problem, exc_info=unexpected)


@contextlib.contextmanager
def open_pipeline(config: Config) -> Iterator[Pipeline]:
    """Load the networks and open the map."""
    settings = config.model
    model = FeatureModel.load(
        settings.network, retrieval=settings.retrieval, num_threads=settings.num_threads
    )
    matcher = load_matcher(
        settings.matcher, model.identity.descriptor_dim, num_threads=settings.num_threads
    )
    with MapReader.open(config.map, model.identity) as reader:
        localizer = Localizer(
            model, reader, config.localizer, clock=time.perf_counter, matcher=matcher
        )
        localizer.check_sessions()
        yield Pipeline(localizer, reader, config.camera.body_from_camera, config.map_frame)
