"""Poses to a text file, a line as soon as it is known."""

from __future__ import annotations

from pathlib import Path

from trigpoint.errors import SourceError
from trigpoint.frame import Localized
from trigpoint.output import open_text
from trigpoint.poses import format_pose
from trigpointd.pipeline import Output


class PoseFile:
    """Writes `time_ns qw qx qy qz tx ty tz`, cam_from_world, of every localized frame."""

    problem = ""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open_text(path)

    def publish(self, output: Output) -> None:
        """Write a line for a localized frame."""
        if not isinstance(output.result, Localized):
            return
        try:
            self._file.write(format_pose(str(output.time_ns), output.result.cam_from_world))
        except OSError as error:
            raise SourceError(f"cannot write {self._path}: {error.strerror}") from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()
