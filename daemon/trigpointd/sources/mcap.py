"""Frames from an MCAP recording: Foxglove's messages or ROS 2's, and our own logs."""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import AsyncGenerator, Collection, Iterator
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel as McapChannel
from mcap.records import Schema
from mcap.writer import MCAP0_MAGIC

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpointd.messages.images import (
    CALIBRATION_TYPES,
    IMAGE_TYPES,
    check_time,
    is_rectified,
    parse_calibration,
    parse_image,
    to_frame,
)
from trigpointd.sources.base import BadFrame, Captured, Channel, Message

_log = logging.getLogger(__name__)
# What mcap and its decompressors (lz4: RuntimeError) raise on bytes that are not as they should
# be, and a disk that fails.
_DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    LookupError,
    RuntimeError,
    MemoryError,
    OverflowError,
    OSError,
)


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
    """

    live = False

    def __init__(
        self, path: Path, *, image_topic: str | None = None, rate: float | None = None
    ) -> None:
        if rate is not None and not rate > 0:
            raise ConfigError(f"a replay at rate {rate} is not possible; give a rate above 0")
        self._rate = rate
        self._recording = _Recording(path)
        try:
            self._image_topic = _choose_image_topic(self._recording, image_topic)
            self._rectified = is_rectified(self._image_topic)
            self._calibration = _choose_calibration(self._recording, self._image_topic)
            self._camera(self._calibration)
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
        captures = self._captures()
        start_s = first_ns = None
        # A future rather than a task: cancelling us must not abandon a thread that still reads.
        ahead = loop.run_in_executor(None, next, captures, None)
        try:
            while True:
                await asyncio.wait([ahead])
                try:
                    captured = ahead.result()
                except SourceError as error:
                    raise SourceError(f"recording {self._recording.path}: {error}") from error
                if captured is None:
                    return
                ahead = loop.run_in_executor(None, next, captures, None)
                if start_s is None or first_ns is None:
                    start_s, first_ns = loop.time(), captured.log_time_ns
                if self._rate is not None:
                    due_s = start_s + (captured.log_time_ns - first_ns) * 1e-9 / self._rate
                    await asyncio.sleep(due_s - loop.time())
                yield captured
        finally:
            await asyncio.gather(ahead, return_exceptions=True)

    async def close(self) -> None:
        """Close the file."""
        self._recording.close()

    def _captures(self) -> Iterator[Captured]:
        # An image before the first calibration takes that one, all others the newest before them.
        calibration, count = self._calibration, 0
        topics = {self._image_topic, calibration.channel.topic}
        for message in self._recording.messages(topics):
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


class _Recording:
    """The messages of a file, through its index where it has one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._stream = path.open("rb")
        except OSError as error:
            raise SourceError(f"cannot open recording {path}: {error.strerror}") from error
        try:
            self._examine()
        except SourceError as error:
            self.close()
            raise SourceError(f"recording {path}: {error}") from error
        if self.cut_off:
            _log.warning("recording %s is cut off; playing what was written whole", path)

    def _examine(self) -> None:
        """Find the channels, and whether there is an index and an end."""
        magic = self._stream.read(len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            raise SourceError("not an MCAP file" if magic else "the file is empty")
        size = self._stream.seek(0, 2)
        self._stream.seek(size - len(MCAP0_MAGIC))
        self.cut_off = size < 2 * len(magic) or self._stream.read() != MCAP0_MAGIC
        self._indexed = False
        try:
            summary = None if self.cut_off else self._seeking_reader().get_summary()
        except _DAMAGE as error:
            raise _damage(error) from error
        if summary is not None and summary.chunk_indexes and summary.channels:
            self._indexed = True
            self.channels = tuple(
                _channel(channel, summary.schemas.get(channel.schema_id))
                for channel in summary.channels.values()
            )
        else:
            self.channels = tuple({message.channel: None for message in self.messages(None)})

    def _seeking_reader(self) -> SeekingReader:
        self._stream.seek(0)
        return SeekingReader(self._stream, validate_crcs=True)

    def messages(self, topics: Collection[str] | None) -> Iterator[Message]:
        """Yield messages in the order of their log times, without an index in that of the file."""
        channels: dict[int, Channel] = {}
        try:
            if self._indexed:
                found = self._seeking_reader().iter_messages(topics)
            else:
                self._stream.seek(0)
                reader = NonSeekingReader(self._stream, validate_crcs=True)
                found = reader.iter_messages(topics, log_time_order=False)
            for schema, channel, message in found:
                if channel.id not in channels:
                    channels[channel.id] = _channel(channel, schema)
                yield Message(
                    channels[channel.id],
                    message.data,
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                )
        except _DAMAGE as error:
            if not self.cut_off:
                raise _damage(error) from error

    def first(self, topic: str) -> Message | None:
        """Return the first message on a topic."""
        return next(self.messages([topic]), None)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _channel(channel: McapChannel, schema: Schema | None) -> Channel:
    topic, encoding = channel.topic, channel.message_encoding
    if schema is None:
        return Channel(topic, encoding, "", "", b"")
    return Channel(topic, encoding, schema.name, schema.encoding, schema.data)


def _type(channel: Channel) -> tuple[str, str]:
    return channel.message_encoding, channel.schema_name


def _damage(error: BaseException) -> SourceError:
    detail = str(error) or type(error).__name__
    return SourceError(f"the file is damaged ({detail}); try `mcap recover`")


def _choose_image_topic(recording: _Recording, wanted: str | None) -> str:
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


def _choose_calibration(recording: _Recording, image_topic: str) -> Message:
    """Return the first calibration of the camera of an image topic.

    It lies in a namespace around the images (`/cam/camera_info` for `/cam/image_raw/compressed`),
    the innermost if there are several; where that leaves a choice, its frame_id tells.
    """
    found = sorted({c.topic for c in recording.channels if _type(c) in CALIBRATION_TYPES})
    firsts = {topic: message for topic in found if (message := recording.first(topic))}
    path = _namespace(image_topic)
    around = {t: len(_namespace(t)) for t in firsts if path[: len(_namespace(t))] == _namespace(t)}
    topics = [t for t, depth in around.items() if depth == max(around.values())] or list(firsts)
    if len(around) == 0 or len(topics) > 1:
        image = recording.first(image_topic)
        frame_id = parse_image(*_type(image.channel), image.data).frame_id if image else ""
        topics = [t for t in topics if frame_id and _frame_id(firsts[t]) == frame_id]
    if len(topics) != 1:
        raise SourceError(
            f"no calibration for the images on {image_topic}, or more than one "
            f"(calibrations on: {_listed(list(firsts))}); record the camera's "
            "sensor_msgs/msg/CameraInfo or foxglove.CameraCalibration in the images' namespace"
        )
    return firsts[topics[0]]


def _namespace(topic: str) -> list[str]:
    return topic.strip("/").split("/")[:-1]


def _frame_id(calibration: Message) -> str:
    return parse_calibration(*_type(calibration.channel), calibration.data).frame_id


def _listed(topics: list[str]) -> str:
    return ", ".join(topics) or "none"
