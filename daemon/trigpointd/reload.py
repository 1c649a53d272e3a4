"""Settings, networks and map taken up anew, under a daemon that goes on."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import ExitStack

from trigpoint.errors import TrigpointError
from trigpointd.backoff import Backoff
from trigpointd.config import Config
from trigpointd.pipeline import Pipeline, open_pipeline
from trigpointd.sd_notify import notify

# What a pipeline is made of; the rest of the settings holds cameras, files and sessions open.
RELOADABLE = frozenset({"map", "map_frame", "camera", "model", "localizer"})
_FAILURES = ("BAD_NETWORK", "INTERNAL_ERROR")  # outcomes that another frame's pipeline may not have
_MAX_FAILURES = 5  # in a row; fewer may be the frames' fault

_log = logging.getLogger(__name__)


class Reloads:
    """Owns the pipeline, and builds another when that `is_due`.

    That is after SIGHUP, from the settings as they then are, and where frame after frame fails,
    from those in force, again and again after growing delays.

    Parameters
    ----------
    config : Config
        The settings at the start.
    read : callable, optional
        Returns the settings as they are now; without it none can be taken up.

    `followers` are told of each new pipeline, and of the settings that are then in force.
    """

    def __init__(self, config: Config, read: Callable[[], Config] | None) -> None:
        self.config = config
        self.read = read
        self._stack = ExitStack()
        self.pipeline = self._stack.enter_context(open_pipeline(config))
        self.is_due = False
        self.followers: list[Callable[[Config, Pipeline], None]] = []
        self._requested = False
        self._num_failures = 0  # in a row
        self._backoff = Backoff(first_s=1.0, max_s=60.0)
        self._restart_s = 0.0  # not before

    def request(self) -> None:
        """Let the next frame wait for the settings as they are now."""
        self._requested = self.is_due = True

    def review(self, outcome: str) -> None:
        """Let the next frame wait for another pipeline if this one does nothing but fail."""
        if outcome not in _FAILURES:
            self._num_failures = 0
            return
        self._num_failures += 1
        now_s = time.monotonic()
        if self._num_failures >= _MAX_FAILURES and now_s >= self._restart_s:
            self._restart_s = now_s + self._backoff.next_s()
            self.is_due = True

    def reload(self) -> Pipeline:
        """Return a new pipeline, or the old one where there can be none."""
        requested, self._requested, self.is_due = self._requested, False, False
        if not requested:
            _log.warning("%d frames in a row failed; a fresh start", self._num_failures)
            self._num_failures = 0
            self._rebuild(lambda: self.config)
            return self.pipeline
        assert self.read is not None  # else nobody requests it
        notify("RELOADING=1")
        if self._rebuild(self.read):
            _log.info("settings, networks and map taken up anew")
        notify("READY=1")
        return self.pipeline

    def close(self) -> None:
        """Let go of the map."""
        self._stack.close()

    def _rebuild(self, read: Callable[[], Config]) -> bool:
        try:
            config = read()
            with ExitStack() as stack:
                pipeline = stack.enter_context(open_pipeline(config))
                self._stack.close()
                self._stack, self.pipeline = stack.pop_all(), pipeline
        except (TrigpointError, OSError) as error:
            _log.error("%s; going on with the settings as they were", error)
            return False
        self._take_up(config)
        return True

    def _take_up(self, config: Config) -> None:
        fixed = sorted(Config.model_fields.keys() - RELOADABLE)
        changed = [name for name in fixed if getattr(config, name) != getattr(self.config, name)]
        if changed:
            _log.warning("changes of %s need a restart", ", ".join(changed))
        self.config = self.config.model_copy(
            update={name: getattr(config, name) for name in RELOADABLE}
        )
        for follow in self.followers:
            follow(self.config, self.pipeline)
