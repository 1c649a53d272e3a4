"""Settings, networks and map taken up anew, under a daemon that goes on."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack

from trigpoint.errors import TrigpointError
from trigpointd.config import Config
from trigpointd.pipeline import Pipeline, open_pipeline
from trigpointd.sd_notify import notify

# What a pipeline is made of; the rest of the settings holds cameras, files and sessions open.
RELOADABLE = frozenset({"map", "map_frame", "camera", "model", "localizer"})

_log = logging.getLogger(__name__)


class Reloads:
    """Owns the pipeline, and builds another from the settings as they are, when that `is_due`.

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

    def request(self) -> None:
        """Let the next frame wait for a reload."""
        self.is_due = True

    def reload(self) -> Pipeline:
        """Return a pipeline of the new settings, or the old one where they cannot be used."""
        assert self.read is not None  # else nobody asks for it
        self.is_due = False
        notify("RELOADING=1")
        try:
            config = self.read()
            with ExitStack() as stack:
                pipeline = stack.enter_context(open_pipeline(config))
                self._stack.close()
                self._stack, self.pipeline = stack.pop_all(), pipeline
        except (TrigpointError, OSError) as error:
            _log.error("%s; going on with the settings as they were", error)
        else:
            self._take_up(config)
        notify("READY=1")
        return self.pipeline

    def close(self) -> None:
        """Let go of the map."""
        self._stack.close()

    def _take_up(self, config: Config) -> None:
        _log.info("settings, networks and map taken up anew")
        fixed = sorted(Config.model_fields.keys() - RELOADABLE)
        changed = [name for name in fixed if getattr(config, name) != getattr(self.config, name)]
        if changed:
            _log.warning("changes of %s need a restart", ", ".join(changed))
        self.config = self.config.model_copy(
            update={name: getattr(config, name) for name in RELOADABLE}
        )
        for follow in self.followers:
            follow(self.config, self.pipeline)
