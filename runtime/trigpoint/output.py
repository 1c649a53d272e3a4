"""Files that results go to."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

from trigpoint.errors import ConfigError


def check_output(path: Path | None, *inputs: Path) -> None:
    """Refuse, before any work is done, what must not or cannot be written."""
    if path is None:
        return
    if not path.parent.is_dir():
        raise ConfigError(f"cannot write {path}: there is no folder {path.parent}")
    if not path.exists():
        return
    if not path.is_file():  # replacing a device or a folder would be worse than an error
        raise ConfigError(f"cannot write {path}: it is not a regular file")
    for other in inputs:
        if other.exists() and path.samefile(other):
            raise ConfigError(f"cannot write {path}: it is an input; name another file")


def open_text(path: Path) -> TextIO:
    """Open a file to write lines to, each of which is on its way once it is written."""
    try:
        return path.open("w", buffering=1)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
