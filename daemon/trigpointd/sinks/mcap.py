"""A log of what came in and what went out, in one MCAP file that replays as a recording."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Self

from mcap.writer import CompressionType, Writer

from trigpoint.errors import ConfigError, SourceError
from trigpointd.config import LogConfig
from trigpointd.messages.cdr import POSE_SCHEMA, POSE_TYPE
from trigpointd.pipeline import Output
from trigpointd.sources.base import Captured, Channel, Message

_CHUNK_BYTES = 256 * 1024
_FLUSH_S = 1.0
_STATUS_SCHEMA = b'{"type": "object"}'


class McapLog:
    """Writes a log; to be called from one thread at a time.

    A crash of the process costs the messages of the chunk in progress: at most `_CHUNK_BYTES` and,
    while messages keep coming, `_FLUSH_S`. A loss of power costs what the operating system has not
    yet put on the disk.

    Where the disk is full, writing raises a `SourceError` and the log is closed; what was written
    before can be read, and the caller goes on without a log.

    Parameters
    ----------
    path : Path
        The file; one that exists is replaced only on request.
    base_key : str
        What the topics of poses and status begin with.
    frames : bool
        Whether to keep the messages that the frames came from; only then does the log replay.
    overwrite : bool
        Whether to replace a file that exists.
    """

    def __init__(
        self, path: Path, base_key: str, *, frames: bool = True, overwrite: bool = False
    ) -> None:
        self._path = path
        self._frames = frames
        try:
            self._stream = path.open("wb" if overwrite else "xb")
        except FileExistsError:
            raise ConfigError(
                f"the log {path} exists; name another file or allow overwriting"
            ) from None
        except OSError as error:
            raise ConfigError(f"cannot write the log {path}: {error.strerror}") from error
        self._pose = Channel(f"{base_key}/pose", "cdr", POSE_TYPE, "ros2msg", POSE_SCHEMA.encode())
        self._status = Channel(
            f"{base_key}/status", "json", "trigpoint.Status", "jsonschema", _STATUS_SCHEMA
        )
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._channel_ids: dict[Channel, int] = {}
        self._calibration: Message | None = None
        self._flushed_s = time.monotonic()
        # JPEG does not shrink, and beside it the rest hardly counts; alone that shrinks by 40 %.
        compression = CompressionType.NONE if frames else CompressionType.ZSTD
        self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES, compression=compression)
        with self._writing():
            self._writer.start(library="trigpoint")

    @classmethod
    def from_config(cls, config: LogConfig, base_key: str) -> Self:
        """Open the log that the settings name; %Y, %H and the like in it stand for now."""
        path = Path(time.strftime(str(config.path)))
        return cls(path, base_key, frames=config.frames, overwrite=config.overwrite)

    def publish(self, output: Output) -> None:
        """Write the messages the frame came from, if asked to, the pose and the status."""
        captured, time_ns = output.captured, output.captured.log_time_ns
        if self._frames:
            self._write_input(captured)
        if output.pose is not None:
            self._write(Message(self._pose, output.pose, time_ns, time_ns))
        self._write(Message(self._status, output.status, time_ns, time_ns))
        if time.monotonic() - self._flushed_s > _FLUSH_S:
            self.flush()

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

    def _write_input(self, captured: Captured) -> None:
        if captured.calibration is not None and captured.calibration is not self._calibration:
            self._write(captured.calibration)
            self._calibration = captured.calibration
        if captured.image is not None:
            self._write(captured.image)

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
