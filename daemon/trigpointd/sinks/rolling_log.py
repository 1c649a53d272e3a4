"""A log that goes on: part after part, room on the disk, and whatever befalls it."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from trigpoint.errors import ConfigError, SourceError, TrigpointError
from trigpoint.output import check_place
from trigpointd.config import LogConfig
from trigpointd.messages.visuals import Visuals
from trigpointd.pipeline import Output
from trigpointd.sinks.log_files import LogFiles
from trigpointd.sinks.mcap import McapLog
from trigpointd.sources.base import Message

_log = logging.getLogger(__name__)
_FIRST_DELAY_S, _MAX_DELAY_S = 1.0, 30.0
_RESUME_RATIO = 1.1  # of the free space asked for, lest it pauses again at once


class RollingLog:
    """Writes a log in parts, each of which replays by itself; to be called from one thread.

    Where it cannot be written, recording pauses: that is said once, tried again after a delay that
    doubles up to `_MAX_DELAY_S`, and goes on in a new part.

    Parameters
    ----------
    config : LogConfig
        Where to write, and when to begin another part.
    base_key : str
        What the topics of poses and status begin with.
    inputs : sequence of Path
        Files that the log must neither replace nor delete.
    required : bool
        Whether it is an error where the log cannot be written at the start, under its very name.
        Otherwise only a log that another daemon is writing is one: it goes on in another part
        beside a file of its name, and where there is no folder recording pauses.
    about : mapping of str, optional
        See `McapLog`.
    clock : callable
        Seconds that do not jump.

    Attributes
    ----------
    problem : str
        Why recording pauses; empty while it goes on.
    num_unlogged : int
        Outputs that are not in the log.
    """

    def __init__(
        self,
        config: LogConfig,
        base_key: str,
        *,
        inputs: Sequence[Path] = (),
        required: bool = False,
        about: Mapping[str, str] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.problem = ""
        self.num_unlogged = 0
        self._config, self._base_key, self._about, self._clock = config, base_key, about, clock
        self._files = LogFiles(config.path)
        self._visuals = Visuals(base_key) if config.visuals else None
        self._part: McapLog | None = None
        self._last_path: Path | None = None
        self._num_unflushed = 0
        self._begun_s = self._flushed_s = self._retry_s = 0.0
        self._delay_s = _FIRST_DELAY_S
        self._check(inputs, required=required)
        try:
            self._begin(self._first_path(required=required))
        except TrigpointError as error:
            if required:
                raise
            self._pause(error)

    @property
    def time_to_flush_s(self) -> float | None:
        """Return when `flush` is due; None where there is nothing to flush."""
        if self._part is None or not self._num_unflushed:
            return None
        return max(0.0, self._flushed_s + self._config.flush_s - self._clock())

    def write(self, output: Output) -> None:
        """Write an output, in a new part where it is time for one."""
        if self._part is None and self._clock() < self._retry_s:
            self.num_unlogged += 1
            return
        self._num_unflushed += 1
        with self._pausing():
            part = self._part or self._begin(self._files.next_part())
            part.publish(output, self._draw(output))
            if self.problem or self.time_to_flush_s == 0:
                self._flush(part)
            if self._is_full(part):
                self._end(part)

    def _draw(self, output: Output) -> Sequence[Message]:
        if self._visuals is None:
            return ()
        try:
            return self._visuals.draw(output)
        except Exception:  # the frames and poses matter more
            _log.exception("what viewers show is left out of the log from here on")
            self._visuals = None
            return ()

    def flush(self) -> None:
        """Wait until the disk has what was written."""
        if self._part is not None:
            with self._pausing():
                self._flush(self._part)

    def close(self) -> None:
        """Write the index of the last part."""
        if self._part is not None:
            with self._pausing():
                self._end(self._part)

    def _first_path(self, *, required: bool) -> Path:
        path = self._files.unnumbered()
        in_the_way = path.exists() and not (required or self._config.overwrite)
        return self._files.next_part() if self._config.rotates or in_the_way else path

    def _check(self, inputs: Sequence[Path], *, required: bool) -> None:
        if required or self._files.folder.is_dir():
            check_place(self._files.unnumbered(), *inputs)
        self._files.check_unused()
        for path in inputs:
            if self._config.min_free_mb and self._files.owns(path):
                raise ConfigError(
                    f"{path} might be deleted as an old part of the log {self._config.path}; "
                    "give the log another name"
                )

    def _begin(self, path: Path) -> McapLog:
        self._make_room()
        self._part = McapLog(
            path,
            self._base_key,
            frames=self._config.frames,
            overwrite=self._config.overwrite,
            about=self._about,
        )
        self._last_path = path
        self._begun_s = self._flushed_s = self._clock()
        return self._part

    def _flush(self, part: McapLog) -> None:
        part.flush()
        self._flushed_s = self._clock()
        self._num_unflushed = 0
        if self.problem:
            _log.warning(
                "recording goes on in %s; %d frames are missing so far",
                part.path,
                self.num_unlogged,
            )
            self.problem = ""
        if part.is_deleted:
            raise SourceError(f"the log {part.path} was deleted")
        self._make_room()

    def _is_full(self, part: McapLog) -> bool:
        max_mb, max_s = self._config.max_part_mb, self._config.max_part_s
        return (max_mb is not None and part.num_bytes >= max_mb * 1e6) or (
            max_s is not None and self._clock() - self._begun_s >= max_s
        )

    def _end(self, part: McapLog) -> None:
        part.close()
        self._part = None
        self._num_unflushed = 0

    def _make_room(self) -> None:
        if self._config.min_free_mb:
            ratio = _RESUME_RATIO if self.problem else 1.0
            self._files.make_room(self._config.min_free_mb * ratio, keep=self._last_path)

    @contextlib.contextmanager
    def _pausing(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # a mistake of ours, too, must not end the thread
            self._pause(error)

    def _pause(self, error: Exception) -> None:
        if self._part is not None:
            with contextlib.suppress(SourceError):
                self._part.close()
            self._part = None
        self.num_unlogged += self._num_unflushed
        self._num_unflushed = 0
        if self.problem:
            self._delay_s = min(2 * self._delay_s, _MAX_DELAY_S)
        else:
            unexpected = None if isinstance(error, TrigpointError) else error
            _log.error(
                "recording pauses: %s; it goes on as soon as it can", error, exc_info=unexpected
            )
            self._delay_s = _FIRST_DELAY_S
        self.problem = str(error) or type(error).__name__
        self._retry_s = self._clock() + self._delay_s
