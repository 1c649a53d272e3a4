"""A recording as a file: its channels, and its messages between two times."""

from __future__ import annotations

import logging
import struct
from collections.abc import Collection, Iterator
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel as McapChannel
from mcap.records import Schema
from mcap.writer import MCAP0_MAGIC

from trigpoint.errors import SourceError
from trigpointd.sources.base import Channel, Message

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


class Recording:
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
            _log.warning(
                "recording %s is cut off; playing what was written whole, of which "
                "`trigpoint-db recover` makes a whole file",
                path,
            )

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

    def messages(
        self, topics: Collection[str] | None, start_ns: int = 0, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield messages in the order of their log times, without an index in that of the file.

        Only those from `start_ns` on and before `end_ns` are given.
        """
        channels: dict[int, Channel] = {}
        try:
            if self._indexed:
                found = self._seeking_reader().iter_messages(
                    topics, starting_at=start_ns, ending_before=end_ns
                )
            else:
                self._stream.seek(0)
                found = NonSeekingReader(self._stream, validate_crcs=True).iter_messages(
                    topics, log_time_order=False, starting_at=start_ns, ending_before=end_ns
                )
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

    def first(self, topic: str, start_ns: int = 0, end_ns: int | None = None) -> Message | None:
        """Return the first message on a topic, at or after a time and before another."""
        return next(self.messages([topic], start_ns, end_ns), None)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def _channel(channel: McapChannel, schema: Schema | None) -> Channel:
    topic, encoding = channel.topic, channel.message_encoding
    if schema is None:
        return Channel(topic, encoding, "", "", b"")
    return Channel(topic, encoding, schema.name, schema.encoding, schema.data)


def _damage(error: BaseException) -> SourceError:
    detail = str(error) or type(error).__name__
    return SourceError(f"the file is damaged ({detail}); try `trigpoint-db recover`")
