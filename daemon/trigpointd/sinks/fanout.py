"""Outputs to several sinks, of which one that fails costs the others nothing."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from trigpoint.errors import TrigpointError
from trigpointd.pipeline import Output
from trigpointd.sinks.base import Sink

_log = logging.getLogger(__name__)


class Fanout:
    """Hands outputs to sinks.

    Parameters
    ----------
    sinks : mapping of str
        The sinks by the names that logs and status have for them.
    required : bool
        Whether an output that a sink cannot take is an error: what is made of a recording is
        whole. Of a camera it is said, once, and the next output is tried.
    """

    def __init__(self, sinks: Mapping[str, Sink], *, required: bool) -> None:
        self.sinks = sinks
        self._required = required
        self._failures: dict[str, str] = {}

    @property
    def problems(self) -> dict[str, str]:
        """Why sinks do not do their work, by name; empty for those that do."""
        return {name: self._failures.get(name) or sink.problem for name, sink in self.sinks.items()}

    def publish(self, output: Output) -> None:
        """Hand an output to every sink."""
        for name, sink in self.sinks.items():
            try:
                sink.publish(output)
            except Exception as error:
                if self._required:
                    raise
                self._fails(name, error)
            else:
                if self._failures.pop(name, ""):
                    _log.info("%s works again", name)

    def _fails(self, name: str, error: Exception) -> None:
        if name not in self._failures:
            known = isinstance(error, TrigpointError)
            _log.error("%s fails: %s; the rest goes on", name, error, exc_info=not known)
        self._failures[name] = str(error) or type(error).__name__
