"""What every sink takes."""

from __future__ import annotations

from typing import Protocol

from trigpointd.pipeline import Output


class Sink(Protocol):
    """Somewhere outputs go; quick, and called from one thread at a time.

    What a sink can mend it mends by itself, and says meanwhile in `problem` why it does not work.
    """

    @property
    def problem(self) -> str:
        """Why outputs do not get through; empty while they do."""
        ...

    def publish(self, output: Output) -> None:
        """Take the output of one frame; a TrigpointError says that this was not possible."""
        ...

    def close(self) -> None:
        """Let go of files and connections."""
        ...
