"""How long to wait before something is tried again."""

from __future__ import annotations

import random


class Backoff:
    """Delays that double from `first_s` to `max_s`, each cut at random by up to a half.

    The cut keeps machines that failed together from trying again together.
    """

    def __init__(
        self, first_s: float = 0.1, max_s: float = 10.0, generator: random.Random | None = None
    ) -> None:
        self._first_s = self._next_s = first_s
        self._max_s = max_s
        self._generator = generator or random.Random()

    def next_s(self) -> float:
        """Return the next delay."""
        delay_s = self._next_s * self._generator.uniform(0.5, 1.0)
        self._next_s = min(2 * self._next_s, self._max_s)
        return delay_s

    def reset(self) -> None:
        """Begin again with the shortest delay."""
        self._next_s = self._first_s
