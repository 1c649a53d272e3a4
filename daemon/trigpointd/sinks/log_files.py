"""The files of a log: their names and numbers, which one goes first, how much room there is."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import re
import shutil
import time
from pathlib import Path

from trigpoint.errors import ConfigError, SourceError

_log = logging.getLogger(__name__)
# What may stand for the time in the name of a log, and what it looks like there.
DIRECTIVES = {"%Y": r"\d{4,}", **dict.fromkeys(("%m", "%d", "%H", "%M", "%S"), r"\d\d")}


class LogFiles:
    """The parts of one daemon's log in their folder.

    A part is named by the time of its start and, but for a log that is one file, by a number:
    `log-%Y%m%d.mcap` gives `log-20261122.000017.mcap`. Numbers rise from run to run, so that a
    lower one is older even where the clock starts anew at each boot.

    Parameters
    ----------
    path : Path
        The log's path; in the name, `DIRECTIVES` stand for the time.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        stem, suffix = (
            "".join(DIRECTIVES.get(part, re.escape(part)) for part in re.split("(%.)", text))
            for text in (path.stem, path.suffix)
        )
        self._name = re.compile(rf"{stem}(?:\.(\d{{6,}}))?{suffix}")

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return self._path.parent

    def owns(self, path: Path) -> bool:
        """Whether a file would pass for a part of this log."""
        return path.parent.resolve() == self.folder.resolve() and bool(
            self._name.fullmatch(path.name)
        )

    def unnumbered(self) -> Path:
        """Return the path of a log that is one file begun now."""
        return self.folder / time.strftime(self._path.name)

    def next_part(self) -> Path:
        """Return the path of a part begun now, after all others."""
        try:
            number = max((self._number(path) for path in self._list()), default=0) + 1
        except OSError as error:
            raise cannot_write(self._path, error) from error
        path = self.unnumbered()
        return path.with_name(f"{path.stem}.{number:06d}{path.suffix}")

    def check_unused(self) -> None:
        """Refuse a log that another program is writing."""
        with contextlib.suppress(OSError):  # a folder that cannot be read is not written either
            for path in self._list():
                if is_locked(path):
                    raise ConfigError(f"another daemon is writing the log {path}; name another one")

    def make_room(self, min_free_mb: float, keep: Path | None) -> None:
        """Delete the oldest part where less than that is free.

        One at a time: on some file systems the room comes a little later. `keep` stays, and so does
        what is being written; a `SourceError` says that nothing is left to delete.
        """
        try:
            if shutil.disk_usage(self.folder).free >= min_free_mb * 1e6:
                return
            oldest = next((path for path in self._oldest_first() if path != keep), None)
            if oldest is None:
                raise SourceError(
                    f"less than {min_free_mb:g} MB are free in {self.folder}, and there is no "
                    "older log to delete"
                )
            oldest.unlink()
            _log.info("deleted the old log %s, to keep %g MB free", oldest, min_free_mb)
        except OSError as error:
            raise SourceError(f"cannot make room in {self.folder}: {error.strerror}") from error

    def _list(self) -> list[Path]:
        return [path for path in self.folder.iterdir() if self._name.fullmatch(path.name)]

    def _oldest_first(self) -> list[Path]:
        parts = [path for path in self._list() if path.is_file() and not is_locked(path)]
        return sorted(parts, key=lambda path: (self._number(path), path.stat().st_mtime_ns))

    def _number(self, path: Path) -> int:
        """Return a part's number; 0 for what was written without rotation."""
        match = self._name.fullmatch(path.name)
        return int(match[1] or 0) if match else 0


def cannot_write(path: Path, error: OSError) -> SourceError:
    """Say why a log cannot be written."""
    return SourceError(f"cannot write the log {path}: {error.strerror}")


def is_locked(path: Path) -> bool:
    """Whether a program is writing a log; a file that cannot be asked is not."""
    try:
        with path.open("rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
