"""A whole file made of an MCAP log that a crash, a loss of power or a bad disk has damaged."""

from __future__ import annotations

import fcntl
import mmap
import os
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer

from trigpoint.errors import ConfigError
from trigpoint.output import check_output
from trigpoint_db.salvage import Salvage

_CHUNK_BYTES = 256 * 1024


@dataclass
class Recovered:
    """What was saved of a log.

    `num_damaged_bytes` are those that could not be read, `num_orphans` messages whose channel was
    among them; a log that is not `finished` ends without its index. Times are of arrival, in ns.
    """

    topics: dict[str, int] = field(default_factory=dict)
    start_time_ns: int = 2**64
    end_time_ns: int = 0
    num_damaged_bytes: int = 0
    num_orphans: int = 0
    finished: bool = False

    def add(self, topic: str, time_ns: int) -> None:
        """Count a message."""
        self.topics[topic] = self.topics.get(topic, 0) + 1
        self.start_time_ns = min(time_ns, self.start_time_ns)
        self.end_time_ns = max(time_ns, self.end_time_ns)

    def __str__(self) -> str:
        start, end = (
            datetime.fromtimestamp(time_ns / 1e9, UTC).isoformat(" ", "milliseconds")
            for time_ns in (self.start_time_ns, self.end_time_ns)
        )
        losses = []
        if not self.finished:
            losses.append("the log was not finished")
        if self.num_damaged_bytes:
            losses.append(f"{self.num_damaged_bytes} bytes of it are lost")
        if self.num_orphans:
            losses.append(f"and with them the topics of {self.num_orphans} messages")
        return (
            f"{sum(self.topics.values())} messages from {start} to {end}; "
            f"{', '.join(losses) or 'nothing was lost'}"
        )


def recover(log: Path, out: Path, *, in_place: bool = False) -> Recovered:
    """Write what is whole in a log to a new file with an index, which appears when it is complete.

    With `in_place` the new file takes the place of the log, and `out` is the log. A `ConfigError`
    says that there is nothing to save, or that a file cannot be read or written.
    """
    check_output(out, *(() if in_place else (log,)))
    if out.exists() and not in_place:
        raise ConfigError(f"{out} exists; remove it first, or name another file with -o")
    partial = out.with_name(out.name + ".partial")
    try:
        with log.open("rb") as stream:
            if in_place:
                _check_unused(log, stream.fileno())
            if os.fstat(stream.fileno()).st_size == 0:
                raise ConfigError(f"{log} is empty; there is nothing to recover")
            with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
                try:
                    recovered = _copy(data, partial)
                    if not recovered.topics:
                        raise ConfigError(f"{log} holds no whole chunk of messages to recover")
                    partial.replace(out)
                finally:
                    partial.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(
            f"cannot recover {log}: {error.filename or out}: {error.strerror}"
        ) from error
    return recovered


def _check_unused(log: Path, descriptor: int) -> None:
    """Refuse a log that is locked, as the daemon does while it writes one."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ConfigError(
            f"a daemon is writing {log}; stop it first, or recover to another file with -o"
        ) from None


def _copy(data: mmap.mmap, out: Path) -> Recovered:
    salvage, recovered = Salvage(data), Recovered()
    with out.open("wb") as stream:
        copy = _Copy(Writer(stream, chunk_size=_CHUNK_BYTES), recovered)
        for record in salvage.summary():
            copy.learn(record, vouched=True)
        for record, vouched in salvage.records():
            copy.add(record, vouched=vouched)
        copy.finish()
        stream.flush()
        os.fsync(stream.fileno())
    recovered.finished = salvage.finished
    recovered.num_damaged_bytes = salvage.num_damaged_bytes
    return recovered


class _Copy:
    """Puts the records of a log into a new one, whose channels and schemas are numbered anew."""

    def __init__(self, writer: Writer, recovered: Recovered) -> None:
        self._writer = writer
        self._recovered = recovered
        self._started = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._channel_ids: dict[tuple[Any, ...], int] = {}

    def learn(self, record: McapRecord, *, vouched: bool) -> None:
        """Take note of a channel or a schema; one not vouched for does not replace another."""
        if isinstance(record, Schema) and (vouched or record.id not in self._schemas):
            self._schemas[record.id] = record
        elif isinstance(record, Channel) and (vouched or record.id not in self._channels):
            self._channels[record.id] = record

    def add(self, record: McapRecord, *, vouched: bool) -> None:
        """Write a record, but for what the writer makes by itself."""
        self._start(record.profile if isinstance(record, Header) else "")
        self.learn(record, vouched=vouched)
        if isinstance(record, Message):
            self._add_message(record)
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def finish(self) -> None:
        """Write the index."""
        self._start("")
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _start(self, profile: str) -> None:
        if not self._started:
            self._writer.start(profile, library="trigpoint-db recover")
            self._started = True

    def _add_message(self, message: Message) -> None:
        channel = self._channels.get(message.channel_id)
        if channel is None or (channel.schema_id and channel.schema_id not in self._schemas):
            self._recovered.num_orphans += 1
            return
        self._writer.add_message(
            self._channel_id(channel),
            message.log_time,
            message.data,
            message.publish_time,
            message.sequence,
        )
        self._recovered.add(channel.topic, message.log_time)

    def _channel_id(self, channel: Channel) -> int:
        schema_id = self._schema_id(self._schemas[channel.schema_id]) if channel.schema_id else 0
        metadata = channel.metadata
        key = (channel.topic, channel.message_encoding, schema_id, *sorted(metadata.items()))
        if key not in self._channel_ids:
            self._channel_ids[key] = self._writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, metadata
            )
        return self._channel_ids[key]

    def _schema_id(self, schema: Schema) -> int:
        key = (schema.name, schema.encoding, schema.data)
        if key not in self._schema_ids:
            self._schema_ids[key] = self._writer.register_schema(*key)
        return self._schema_ids[key]
