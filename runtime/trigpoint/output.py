"""Files that results go to."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TextIO

from trigpoint.errors import ConfigError


def check_output(path: Path | None, *inputs: Path, in_place: bool = False) -> None:
    """Refuse, before any work is done, what must not or cannot be written.

    One that is not written `in_place` is made beside it, and takes its name when it is complete.
    """
    if path is None:
        return
    check_place(path, *inputs)
    target = path.resolve()  # through a link, to what it names
    if not os.access(target if in_place and target.exists() else target.parent, os.W_OK):
        raise ConfigError(f"cannot write {path}: permission denied, or the disk is read-only")


def check_place(path: Path, *inputs: Path) -> None:
    """Refuse what must not be written, whether or not it could be now."""
    folder = path.resolve().parent
    if not folder.is_dir():
        raise ConfigError(f"cannot write {path}: there is no folder {folder}")
    if not path.exists():
        if path.resolve() in [other.resolve() for other in inputs]:
            raise ConfigError(f"cannot write {path}: it is named twice; name another file")
        return
    if not path.is_file():  # replacing a device or a folder would be worse than an error
        raise ConfigError(f"cannot write {path}: it is not a regular file")
    for other in inputs:
        if other.exists() and path.samefile(other):
            raise ConfigError(f"cannot write {path}: it is an input; name another file")


def write_atomically(path: Path, contents: str | bytes) -> None:
    """Write a file, text as UTF-8, that appears under its name once it is whole."""
    check_output(path)
    path = path.resolve()  # through a link, to what it names
    partial = path.with_name(path.name + ".partial")
    try:
        try:
            partial.write_bytes(contents.encode() if isinstance(contents, str) else contents)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error


def open_text(path: Path) -> TextIO:
    """Open a file to write lines to, each of which is on its way once it is written."""
    try:
        return path.open("w", buffering=1)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
