"""What every source of frames gives, and the messages it took them from."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from dataclasses import dataclass, field
from typing import Protocol

from trigpoint.frame import Frame


@dataclass(frozen=True)
class Channel:
    """What MCAP tells of the messages on a topic; the schema is empty where there is none."""

    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes = field(repr=False)


@dataclass(frozen=True, eq=False)
class Message:
    """A message as it came, so that a log can keep it and a replay sees the same."""

    channel: Channel
    data: bytes = field(repr=False)
    log_time_ns: int  # of arrival
    publish_time_ns: int
    sequence: int = 0


@dataclass(frozen=True)
class BadFrame:
    """A frame that cannot be used, or that there is none; the stream goes on."""

    time_ns: int
    name: str
    detail: str
    reason: str = "BAD_FRAME"


@dataclass(frozen=True, eq=False)
class Captured:
    """A frame and where it came from.

    A source that reads messages passes them on: the image, and the calibration in force, which
    stays the same object until another one arrives. The two suffice to make the frame again, so a
    log of them replays like the original, also where frames in between were dropped.
    """

    frame: Frame | BadFrame
    log_time_ns: int  # of arrival
    image: Message | None = None
    calibration: Message | None = None
    num_missed: int = 0  # frames that the camera or its driver lost so far


class Source(Protocol):
    """A camera or a recording.

    `live` says what to do with a frame that comes while another is being localized: of a live
    source the newest frame wins, of a recording every frame is processed. `problem` says why there
    are no frames; it is empty while they come.

    A frame that cannot be used is a `BadFrame`; a source that cannot go on raises a
    `SourceError`. Iterate within `contextlib.aclosing`, and close the source afterwards.
    """

    live: bool
    problem: str

    def frames(self) -> AsyncGenerator[Captured, None]:
        """Yield frames as they come, until a recording ends or the task is cancelled."""
        ...

    async def close(self) -> None:
        """Release the camera or the file."""
        ...
