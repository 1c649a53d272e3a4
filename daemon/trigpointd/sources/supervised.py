"""A camera for as long as the daemon runs, whatever the camera does."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import time
from collections.abc import AsyncGenerator
from typing import Protocol

from trigpoint.errors import ConfigError, SourceError, TrigpointError
from trigpoint.frame import Frame
from trigpointd.backoff import Backoff
from trigpointd.sources.base import BadFrame, Captured

_log = logging.getLogger(__name__)
_LASTING_S = 10.0


class LiveSource(Protocol):
    """A camera, each of whose streams is opened, read and at its end closed by `frames`.

    A stream ends with a `SourceError` where the camera is lost or cannot be opened now, and with a
    `ConfigError` where no other try would help. Errors are named by the supervisor.
    """

    name: str  # what messages call it

    def describe(self) -> str:
        """Open the camera and say what it delivers."""
        ...

    def frames(self) -> AsyncGenerator[Captured, None]:
        """Open the camera and yield frames as they come, until it is lost."""
        ...

    async def close(self) -> None:
        """Release what the source holds between streams."""
        ...


class SupervisedSource:
    """Streams a camera; one that is lost is opened again, with growing delays, until it works.

    Each failed try yields a `BadFrame` of reason NO_FRAMES. What is wrong is logged once until
    frames come again; numbers alone make no other problem.

    Parameters
    ----------
    source : LiveSource
        The camera.
    backoff : Backoff, optional
        The delays between tries.
    lasting_s : float
        After a stream that gave usable frames for so long, they begin with the shortest again.

    Attributes
    ----------
    problem : str
        Why there are no frames; empty while there are.
    """

    live = True

    def __init__(
        self,
        source: LiveSource,
        *,
        backoff: Backoff | None = None,
        lasting_s: float = _LASTING_S,
    ) -> None:
        self.problem = ""
        self._source = source
        self._backoff = backoff or Backoff()
        self._lasting_s = lasting_s
        self._reported: set[str] = set()  # problems since there were frames
        self._usable_since_s: float | None = None  # of this stream
        self._delivered = False  # ever
        self._num_missed = 0

    def describe(self) -> str:
        """Open the camera and say what it delivers."""
        try:
            return f"{self._source.name}: {self._source.describe()}"
        except TrigpointError as error:
            raise type(error)(f"{self._source.name}: {error}") from error

    async def frames(self) -> AsyncGenerator[Captured, None]:
        """Yield frames as the camera gives them.

        Raises
        ------
        ConfigError
            Before the first usable frame, where no other try would help.
        """
        while True:
            self._usable_since_s = None
            try:
                async with contextlib.aclosing(self._source.frames()) as stream:
                    async for captured in stream:
                        self._take(captured)
                        yield captured
            except ConfigError as error:
                if not self._delivered:
                    raise ConfigError(f"{self._source.name}: {error}") from error
                self._report(error)
            except Exception as error:
                self._report(error)
            else:
                self._report(SourceError("its stream ended"))
            now_ns = time.time_ns()
            missing = BadFrame(now_ns, self._source.name, self.problem, "NO_FRAMES")
            yield Captured(missing, now_ns, num_missed=self._num_missed)
            await asyncio.sleep(self._backoff.next_s())

    async def close(self) -> None:
        """Release what the camera holds."""
        await self._source.close()

    def _take(self, captured: Captured) -> None:
        self._num_missed = captured.num_missed
        if not isinstance(captured.frame, Frame):
            return
        now_s = time.monotonic()
        if self._usable_since_s is None:
            self._usable_since_s = now_s
        elif now_s - self._usable_since_s >= self._lasting_s:
            self._backoff.reset()
        if self.problem or not self._delivered:
            _log.info("%s: frames come", self._source.name)
        self.problem = ""
        self._reported.clear()
        self._delivered = True

    def _report(self, error: Exception) -> None:
        unexpected = not isinstance(error, TrigpointError)
        what = f"{type(error).__name__}: {error}" if unexpected else str(error)
        self.problem = f"{self._source.name}: {' '.join(what.split())}"
        kind = re.sub(r"\d+", "", self.problem)
        if kind not in self._reported:
            self._reported.add(kind)
            exc_info = error if unexpected else None
            _log.warning("%s; trying again", self.problem, exc_info=exc_info)
