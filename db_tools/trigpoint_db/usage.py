"""Which images of a map are of use, from the status messages in the daemon's logs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from trigpoint.errors import ConfigError
from trigpoint_db.statuses import read_statuses


@dataclass
class Usage:
    """How often an image, or those of a session together, took part."""

    num_retrieved: int = 0  # frames that it was matched with
    num_localized: int = 0  # frames, of these, that got a pose
    num_supported: int = 0  # poses with inliers that it sees

    def add(self, other: Usage) -> None:
        """Count what another one counted."""
        self.num_retrieved += other.num_retrieved
        self.num_localized += other.num_localized
        self.num_supported += other.num_supported


def count_usage(logs: Iterable[Path]) -> tuple[dict[str, Usage], int]:
    """Count for each image that frames were matched with; returns the number of frames, too."""
    usage: dict[str, Usage] = {}
    num_frames = 0
    for log in {log.resolve(): log for log in logs}.values():
        for topic, data in read_statuses(log):
            num_frames += 1
            try:
                status = json.loads(data)
                anchors = [str(name) for name in status.get("anchors", ())]  # BAD_FRAME has none
                is_localized = status["status"] == "LOCALIZED"
                inliers = status["anchor_inliers"] if is_localized else [0] * len(anchors)
                counts = zip(anchors, map(int, inliers), strict=True)
                for name, num_inliers in counts:
                    of_image = usage.setdefault(name, Usage())
                    of_image.add(Usage(1, is_localized, num_inliers > 0))
            except (KeyError, ValueError, TypeError, AttributeError) as error:
                raise ConfigError(
                    f"{log}: {data[:80]!r} on {topic} is not a status of this version's trigpointd"
                ) from error
    if not num_frames:
        raise ConfigError(
            f"there is no status in {', '.join(map(str, logs))}; give MCAP logs of trigpointd"
        )
    return usage, num_frames


def find_unused(usage: Mapping[str, Usage], names: Iterable[str], min_frames: int) -> list[str]:
    """Return images that took part in the localization of many frames and supported none.

    Images that no frame came near to are not among them: nothing is known of those.
    """
    return [
        name
        for name in names
        if name in usage
        and usage[name].num_localized >= min_frames
        and usage[name].num_supported == 0
    ]
