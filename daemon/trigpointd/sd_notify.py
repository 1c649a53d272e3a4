"""Tell systemd how the service is (sd_notify(3)); does nothing where systemd did not start it."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Mapping

PERIOD_S = 2.0

_log = logging.getLogger(__name__)


def notify(state: str) -> None:
    """Send a state such as `READY=1`."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):  # Linux's abstract namespace
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        try:
            channel.connect(address)
            channel.sendall(state.encode())
        except OSError as error:  # no reason to stop localizing
            _log.warning("cannot notify systemd: %s", error.strerror)


class Heartbeat:
    """What systemd hears of the localize loop: that it lives, and how it does.

    The watchdog is fed only by `beat`, which the loop calls between frames and every `period_s`
    while there are none: a camera without frames is no hang, a network that never returns is.
    """

    def __init__(self) -> None:
        limit_us = os.environ.get("WATCHDOG_USEC", "")  # systemd's WatchdogSec=
        limit_s = int(limit_us) / 1e6 if limit_us.isdecimal() else 0.0
        self.period_s = min(PERIOD_S, limit_s / 4) or PERIOD_S
        self._due_s = 0.0
        self._frame_s: float | None = None
        self._outcome = ""

    def frame(self, outcome: str) -> None:
        """Take note of what came of a frame, or that there is none."""
        if outcome != "NO_FRAMES":
            self._frame_s = time.monotonic()
        self._outcome = outcome

    def beat(self, totals: object, problems: Mapping[str, str]) -> None:
        """Feed the watchdog and say how it goes, at most once in `period_s`."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + self.period_s
        parts = [self._describe(now_s), *(f"{name}: {text}" for name, text in problems.items())]
        notify(f"WATCHDOG=1\nSTATUS={'; '.join(parts)}; {totals}")

    def _describe(self, now_s: float) -> str:
        if self._frame_s is None:
            return "waiting for the first frame"
        idle_s = now_s - self._frame_s
        arriving = "frames arrive" if idle_s < 2 * PERIOD_S else f"no frame for {idle_s:.0f} s"
        return f"{arriving}, last {self._outcome}"
