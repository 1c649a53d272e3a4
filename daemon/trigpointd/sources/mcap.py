"""Frames from an MCAP recording: Foxglove's messages or ROS 2's, and our own logs."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Generator, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from trigpoint.camera import Camera
from trigpoint.camera_messages import check_time, choose_calibration, is_rectified
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpointd.messages.images import (
    CALIBRATION_TYPES,
    IMAGE_TYPES,
    parse_calibration,
    parse_image,
    to_frame,
)
from trigpointd.sources.base import BadFrame, Captured, Channel, Message
from trigpointd.sources.lookahead import read_ahead
from trigpointd.sources.recording import Recording

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_NEVER_S = 1e9
_ONLY_FRAME_NS = 10**8  # how long a recording of a single frame lasts, in a loop


class McapSource:
    """Plays one camera of a recording, every frame of it.

    Parameters
    ----------
    path : Path
        The recording. One that was cut off, by a crash say, plays up to its last whole chunk.
    image_topic : str, optional
        Needed only where the recording holds several cameras.
    rate : float, optional
        1 plays at the recorded pace, 2 twice as fast; None as fast as the frames are taken.
    start_s, end_s : float
        Which part to play, in seconds since the first image, by the times of arrival; the end,
        which is not played any more, is that of the recording by default.
    start_time, end_time : datetime, optional
        The same as times of arrival, with their time zone; where both kinds are given, both hold.
    loop : bool
        Whether to begin again at the end. All times then go on from where they were, so that they
        rise: what comes in the second round is stamped as if the recording went on at its mean
        pace. The messages that it came from, which say otherwise, do not come along.
    """

    live = False
    problem = ""

    def __init__(
        self,
        path: Path,
        *,
        image_topic: str | None = None,
        rate: float | None = None,
        start_s: float = 0.0,
        end_s: float | None = None,
        start_time: datetime | None = None,
        end_time: datetime | None = None,
        loop: bool = False,
    ) -> None:
        if rate is not None and not rate > 0:
            raise ConfigError(f"a replay at rate {rate} is not possible; give a rate above 0")
        end_s = _NEVER_S if end_s is None else min(end_s, _NEVER_S)
        if not 0 <= start_s < end_s:
            raise ConfigError(
                f"a replay from {start_s:g} s to {end_s:g} s is not possible; give a start of 0 or "
                "more and an end after it"
            )
        self._rate = rate
        self._loop = loop
        self._recording = Recording(path)
        try:
            self._image_topic = _choose_image_topic(self._recording, image_topic)
            self._rectified = is_rectified(self._image_topic)
            self._calibration = _choose_calibration(self._recording, self._image_topic)
            self._camera(self._calibration)
            self._choose_part(start_s, end_s, start_time, end_time)
        except SourceError as error:
            self._recording.close()
            raise SourceError(f"recording {path}: {error}") from error

    def describe(self) -> str:
        """Say what it delivers."""
        camera = self._camera(self._calibration).to_text()
        return f"{self._recording.path}: images on {self._image_topic}, {camera}"

    async def frames(self) -> AsyncGenerator[Captured, None]:
        """Yield the frames in their recorded order; the next is decoded while one is in use."""
        loop = asyncio.get_running_loop()
        start_s = first_ns = None
        try:
            async with contextlib.aclosing(read_ahead(self._captures())) as captures:
                async for captured in captures:
                    if start_s is None or first_ns is None:
                        start_s, first_ns = loop.time(), captured.log_time_ns
                    if self._rate is not None:
                        due_s = start_s + (captured.log_time_ns - first_ns) * 1e-9 / self._rate
                        await asyncio.sleep(due_s - loop.time())
                    yield captured
        except SourceError as error:
            raise SourceError(f"recording {self._recording.path}: {error}") from error

    async def close(self) -> None:
        """Close the file."""
        self._recording.close()

    def _choose_part(
        self, start_s: float, end_s: float, start_time: datetime | None, end_time: datetime | None
    ) -> None:
        """Set the times of arrival between which to play, and the calibration at the start."""
        topic, first = self._image_topic, self._recording.first(self._image_topic)
        assert first is not None  # else the topic would not have been chosen
        first_ns = first.log_time_ns
        self._start_ns = first_ns + round(start_s * 1e9)
        self._end_ns = first_ns + round(end_s * 1e9)
        if start_time is not None:
            self._start_ns = max(self._start_ns, _time_ns(start_time))
        if end_time is not None:
            self._end_ns = min(self._end_ns, _time_ns(end_time))
        if self._start_ns == first_ns < self._end_ns:
            self._start_ns = 0  # with calibrations before the first image
            return
        if (
            self._start_ns >= self._end_ns
            or self._recording.first(topic, self._start_ns, self._end_ns) is None
        ):
            last_ns = max(message.log_time_ns for message in self._recording.messages([topic]))
            start_s, end_s, last_s = (
                (time_ns - first_ns) / 1e9 for time_ns in (self._start_ns, self._end_ns, last_ns)
            )
            end = "" if end_s == _NEVER_S else f" to {end_s:g} s"
            raise SourceError(
                f"no images from {start_s:g} s{end}; the last is at {last_s:.3f} s, "
                f"{datetime.fromtimestamp(last_ns / 1e9, UTC):%Y-%m-%dT%H:%M:%SZ}"
            )
        for message in self._recording.messages(
            [self._calibration.channel.topic], end_ns=self._start_ns
        ):
            self._calibration = message

    def _captures(self) -> Generator[Captured, None, None]:
        """Yield what is played, in a loop all of it again and again, at later times."""
        if not self._loop:
            yield from self._round()
            return
        shift_ns = count = 0
        while True:
            times_ns = []  # of arrival and of capture
            for captured in self._round(count):
                times_ns.append((captured.log_time_ns, captured.frame.time_ns))
                yield _shifted(captured, shift_ns)
            length_ns = max(max(times) - min(times) for times in zip(*times_ns, strict=True))
            shift_ns += length_ns + (length_ns // max(1, len(times_ns) - 1) or _ONLY_FRAME_NS)
            count += len(times_ns)

    def _round(self, count: int = 0) -> Iterator[Captured]:
        # An image before the first calibration takes that one, all others the newest before them.
        calibration = self._calibration
        topics = {self._image_topic, calibration.channel.topic}
        for message in self._recording.messages(topics, self._start_ns, self._end_ns):
            if message.channel.topic != self._image_topic:
                calibration = message
                continue
            frame = self._decode(message, calibration, f"{self._image_topic}#{count}")
            yield Captured(frame, message.log_time_ns, message, calibration)
            count += 1

    def _decode(self, image: Message, calibration: Message, name: str) -> Frame | BadFrame:
        time_ns = image.log_time_ns
        try:
            parsed = parse_image(*_type(image.channel), image.data)
            time_ns = parsed.time_ns or time_ns
            check_time(time_ns)
            return to_frame(parsed, self._camera(calibration), time_ns, name)
        except SourceError as error:
            return BadFrame(time_ns, name, str(error))

    def _camera(self, calibration: Message) -> Camera:
        parsed = parse_calibration(*_type(calibration.channel), calibration.data)
        return parsed.camera(rectified=self._rectified)


def _time_ns(time: datetime) -> int:
    return (time - _EPOCH) // timedelta(microseconds=1) * 1000


def _shifted(captured: Captured, shift_ns: int) -> Captured:
    """Return a frame at another time, without the messages that tell the one it was taken at."""
    frame = replace(captured.frame, time_ns=captured.frame.time_ns + shift_ns)
    return Captured(frame, captured.log_time_ns + shift_ns)


def _type(channel: Channel) -> tuple[str, str]:
    return channel.message_encoding, channel.schema_name


def _choose_image_topic(recording: Recording, wanted: str | None) -> str:
    found = sorted({c.topic for c in recording.channels if _type(c) in IMAGE_TYPES})
    topics = [topic for topic in found if recording.first(topic) is not None]
    if wanted is not None and wanted not in topics:
        raise SourceError(f"no images on topic {wanted}; there are {_listed(topics)}")
    if not topics:
        every = sorted({f"{c.topic} ({c.schema_name})" for c in recording.channels})
        raise SourceError(f"no images of a known type; the topics are {_listed(every)}")
    if wanted is None and len(topics) > 1:
        raise SourceError(f"several cameras: name one image topic of {_listed(topics)}")
    return wanted or topics[0]


def _choose_calibration(recording: Recording, image_topic: str) -> Message:
    """Return the first calibration of the camera of an image topic."""
    found = sorted({c.topic for c in recording.channels if _type(c) in CALIBRATION_TYPES})
    firsts = {topic: message for topic in found if (message := recording.first(topic))}

    def is_in_frame(topic: str) -> bool:
        image = recording.first(image_topic)
        frame_id = parse_image(*_type(image.channel), image.data).frame_id if image else ""
        return frame_id != "" and _frame_id(firsts[topic]) == frame_id

    return firsts[choose_calibration(image_topic, firsts, is_in_frame)]


def _frame_id(calibration: Message) -> str:
    return parse_calibration(*_type(calibration.channel), calibration.data).frame_id


def _listed(topics: list[str]) -> str:
    return ", ".join(topics) or "none"
