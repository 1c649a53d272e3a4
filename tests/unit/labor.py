"""Work for processes, in a module that is quickly imported."""

import os
import signal
from pathlib import Path
from typing import TextIO


def square(number: int) -> int:
    return number * number


def die_of_seven(number: int) -> int:
    if number == 7:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_once(marker: Path) -> str:
    """Die, but not where somebody has died before."""
    if marker.exists():
        return marker.name
    marker.touch()
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def lack_memory_once(marker: Path) -> str:
    if marker.exists():
        return marker.name
    marker.touch()
    raise MemoryError


def open_file(path: Path) -> TextIO:
    """Return what cannot be pickled."""
    return path.open("w")


class OddError(Exception):
    """Can be pickled, but not be made anew of what it was pickled to."""

    def __init__(self, name: str, why: str) -> None:
        super().__init__(name)


def raise_odd_error(name: str) -> None:
    raise OddError(name, "")
