"""What every sink takes."""

from __future__ import annotations

from typing import Protocol

from trigpointd.pipeline import Output


class Sink(Protocol):
    """Somewhere outputs go; quick, and called from one thread at a time."""

    def publish(self, output: Output) -> None:
        """Take the output of one frame; a TrigpointError says that no further one can be taken."""
        ...

    def close(self) -> None:
        """Let go of files and connections."""
        ...
