"""A log of what came in and what went out, in one MCAP file that replays as a recording."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Self

from mcap.writer import CompressionType, Writer

from trigpoint.errors import ConfigError, SourceError
from trigpointd.messages.cdr import POSE_SCHEMA, POSE_TYPE
from trigpointd.sources.base import Captured, Channel, Message

_CHUNK_BYTES = 256 * 1024
_FLUSH_S = 1.0
_ANY_OBJECT: Mapping[str, object] = {"type": "object"}


class McapLog:
    """Writes a log; not safe to call from two threads at once.

    A crash of the process costs the messages of the chunk in progress: at most `_CHUNK_BYTES` and,
    while messages keep coming, `_FLUSH_S`. A loss of power costs what the operating system has not
    yet put on the disk. Everything is zstd: that costs 0.1 ms on a JPEG frame, and shrinks raw
    images by a third, poses and status by 40 %.

    Where the disk is full a write raises a `SourceError` and the log is closed; what was written
    before can be read, and the caller goes on without a log.

    Parameters
    ----------
    path : Path
        The file; one that exists is overwritten only on request.
    base : str
        What the pose's and the status' topic begin with.
    status_schema : mapping, optional
        JSON schema of the status.
    overwrite : bool, optional
        Whether to replace a file that exists.
    """

    def __init__(
        self,
        path: Path,
        base: str,
        *,
        status_schema: Mapping[str, object] = _ANY_OBJECT,
        overwrite: bool = False,
    ) -> None:
        self._path = path
        try:
            self._stream = path.open("wb" if overwrite else "xb")
        except FileExistsError:
            raise ConfigError(f"the log {path} exists; name another file") from None
        except OSError as error:
            raise ConfigError(f"cannot write the log {path}: {error.strerror}") from error
        self._pose = Channel(f"{base}/pose", "cdr", POSE_TYPE, "ros2msg", POSE_SCHEMA.encode())
        schema = json.dumps(status_schema).encode()
        self._status = Channel(f"{base}/status", "json", "trigpoint.Status", "jsonschema", schema)
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._channel_ids: dict[Channel, int] = {}
        self._calibration: Message | None = None
        self._flushed_s = time.monotonic()
        self._writer = Writer(
            self._stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        with self._writing():
            self._writer.start(library="trigpoint")

    def write_input(self, captured: Captured) -> None:
        """Write the messages that a frame came from as they are, a calibration once."""
        if captured.calibration is not None and captured.calibration is not self._calibration:
            self._write(captured.calibration)
            self._calibration = captured.calibration
        if captured.image is not None:
            self._write(captured.image)

    def write_pose(self, log_time_ns: int, cdr: bytes) -> None:
        """Write a pose as it was published."""
        self._write(Message(self._pose, cdr, log_time_ns, log_time_ns))

    def write_status(self, log_time_ns: int, status_json: bytes) -> None:
        """Write a status as it was published."""
        self._write(Message(self._status, status_json, log_time_ns, log_time_ns))

    def flush(self) -> None:
        """Close the chunk in progress and hand it to the operating system."""
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
        self._flushed_s = time.monotonic()

    def close(self) -> None:
        """Write the index and close the file."""
        if self._stream.closed:
            return
        with self._writing():
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def _write(self, message: Message) -> None:
        with self._writing():
            self._writer.add_message(
                self._channel_id(message.channel),
                message.log_time_ns,
                message.data,
                message.publish_time_ns,
                message.sequence,
            )
            self._stream.flush()  # without effect unless a chunk was just closed
        if time.monotonic() - self._flushed_s > _FLUSH_S:
            self.flush()

    def _channel_id(self, channel: Channel) -> int:
        if channel not in self._channel_ids:
            self._channel_ids[channel] = self._writer.register_channel(
                channel.topic, channel.message_encoding, self._schema_id(channel)
            )
        return self._channel_ids[channel]

    def _schema_id(self, channel: Channel) -> int:
        schema = (channel.schema_name, channel.schema_encoding, channel.schema)
        if schema == ("", "", b""):
            return 0  # MCAP's way to say that there is none
        if schema not in self._schema_ids:
            self._schema_ids[schema] = self._writer.register_schema(*schema)
        return self._schema_ids[schema]

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        if self._stream.closed:
            raise SourceError(f"the log {self._path} is closed")
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):  # it tries to write the rest once more
                self._stream.close()
            raise SourceError(
                f"cannot write the log {self._path}: {error.strerror}; it ends here"
            ) from error
