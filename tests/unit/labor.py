"""Work for processes, in a module that is quickly imported."""

import os
import signal
from pathlib import Path


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
