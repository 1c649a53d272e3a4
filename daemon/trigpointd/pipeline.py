"""From a captured frame to what is published of it; no sockets, no tasks, no waiting."""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Iterator, Mapping
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

_log = logging.getLogger(__name__)


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
        self._map_problem = ""
        self._reported: set[str] = set()  # what is wrong with the map or a network, said once
        self._body_from_camera = body_from_camera
        self._map_frame = map_frame

    def process(
        self, captured: Captured, num_dropped: int, log: Mapping[str, object] | None = None
    ) -> Output:
        """Localize one frame.

        `num_dropped` is how many the slot has dropped so far, `log` what the log reports.
        """
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
            "num_dropped": num_dropped,
            "num_missed": captured.num_missed,
            "map_generation": self.reader.generation,
            **(log or {}),
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
            if self.reader.refresh():
                _log.info("the map is now of generation %d", self.reader.generation)
                self._look_for_sessions()
        except DatabaseError as error:
            problem = str(error)
        if problem and problem != self._map_problem:
            _log.error("%s; going on with the map as it was", problem)
        self._map_problem = problem

    def _look_for_sessions(self) -> None:
        try:
            self.localizer.check_sessions()
        except ConfigError as error:
            self._report(f"{error}; going on without it")

    def _localize(self, frame: Frame | BadFrame, prior: Prior | None) -> Result | Failed:
        if isinstance(frame, BadFrame):
            return Failed("BAD_FRAME", frame.detail)
        try:
            return self.localizer.localize(frame, prior)
        except (DatabaseError, ModelError) as error:
            # A damaged image of the map, or a network that fails on this frame: others may do.
            self._report(str(error))
            reason = "BAD_MAP" if isinstance(error, DatabaseError) else "BAD_NETWORK"
            return Failed(reason, str(error))

    def _report(self, problem: str) -> None:
        """Say once what is wrong."""
        if problem not in self._reported:
            self._reported.add(problem)
            _log.error("%s", problem)


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
