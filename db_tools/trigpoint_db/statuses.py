"""The daemon's status messages, out of its MCAP log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from trigpoint.errors import ConfigError
from trigpoint_db.salvage import DAMAGE


def read_statuses(log: Path) -> Iterator[tuple[str, bytes]]:
    """Yield topic and data of each status in a log, as far as the log is whole."""
    try:
        with log.open("rb") as stream:
            whole = _is_whole(stream)
            try:
                yield from _statuses(stream)
            except DAMAGE as error:
                if whole:
                    detail = str(error) or type(error).__name__
                    raise ConfigError(
                        f"{log} is damaged ({detail}); try `trigpoint-db recover`"
                    ) from error
    except OSError as error:
        raise ConfigError(f"cannot read {log}: {error.strerror}") from error


def _is_whole(stream: BinaryIO) -> bool:
    """Say whether the file has its end."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - len(MCAP0_MAGIC)))
    end = stream.read()
    stream.seek(0)
    return end == MCAP0_MAGIC


def _statuses(stream: BinaryIO) -> Iterator[tuple[str, bytes]]:
    """Yield topic and data of the JSON messages on topics that end in `/status`."""
    topics: dict[int, str] = {}
    # The one of mcap's readers that gives what there is of a log without an end.
    for record in StreamReader(stream, validate_crcs=True).records:
        if isinstance(record, Channel) and record.message_encoding == "json":
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id, "")
            if topic.endswith("/status"):
                yield topic, record.data
