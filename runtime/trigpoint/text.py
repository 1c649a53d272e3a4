"""Text files that are written line by line."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

from trigpoint.errors import ConfigError


def open_text(path: Path) -> TextIO:
    """Open a file to write lines to, each of which is on its way once it is written."""
    try:
        return path.open("w", buffering=1)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
