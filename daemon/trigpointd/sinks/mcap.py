"""A log of what came in and what went out, in an MCAP file that replays as a recording."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpointd.messages.foxglove import calibration_message, gray_image, image_message
from trigpointd.messages.published import Published
from trigpointd.pipeline import Output
from trigpointd.sinks.log_files import cannot_write
from trigpointd.sources.base import Captured, Channel, Message

_CHUNK_BYTES = 256 * 1024


class McapLog:
    """Writes one file; to be called from one thread at a time.

    A crash of the process costs the messages of the chunk in progress, which are at most
    `_CHUNK_BYTES`; a loss of power costs what came since the last `flush`. The file is locked while
    it is open.

    Where the disk is full, writing raises a `SourceError` and the file is closed; what was written
    before can be read, and a file without any message does not stay.

    Parameters
    ----------
    path : Path
        The file; one that exists is replaced only on request.
    base_key : str
        What the topics of poses and status begin with.
    frames : bool
        Whether to keep what the poses were made from; only then does the log replay. Messages are
        kept as they came; frames of a source without messages are written as Foxglove's.
    overwrite : bool
        Whether to replace a file that exists.
    about : mapping of str, optional
        What is to be known of the whole file; it becomes the metadata record `trigpoint`.
    """

    def __init__(
        self,
        path: Path,
        base_key: str,
        *,
        frames: bool = True,
        overwrite: bool = False,
        about: Mapping[str, str] | None = None,
    ) -> None:
        self.path = path
        self._frames = frames
        self._stream = _open(path, overwrite=overwrite)
        self._published = Published(base_key)
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._channel_ids: dict[Channel, int] = {}
        self._calibration: Message | None = None
        self._camera: Camera | None = None
        # JPEG does not shrink, and beside it the rest hardly counts; alone that shrinks by 40 %.
        compression = CompressionType.NONE if frames else CompressionType.ZSTD
        self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES, compression=compression)
        self._start_bytes = self.num_bytes = 0
        with self._writing():
            self._writer.start(library="trigpoint")
            if about is not None:
                self._writer.add_metadata("trigpoint", dict(about))
            self._stream.flush()
            self._start_bytes = self.num_bytes = self._stream.tell()

    @property
    def holds_messages(self) -> bool:
        """Whether a chunk has reached the file."""
        return self.num_bytes > self._start_bytes

    @property
    def is_deleted(self) -> bool:
        """Whether nobody can find the file any more."""
        return os.fstat(self._stream.fileno()).st_nlink == 0

    def publish(self, output: Output, visuals: Iterable[Message] = ()) -> None:
        """Write what the frame came from, if asked to, the pose, the status and what is drawn."""
        if self._frames:
            self._write_input(output.captured)
        for message in (*self._published.of(output), *visuals):
            self._write(message)

    def flush(self) -> None:
        """Close the chunk in progress and wait until the disk has it."""
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
            os.fdatasync(self._stream.fileno())
            self.num_bytes = self._stream.tell()

    def close(self) -> None:
        """Write the index and close the file."""
        if self._stream.closed:
            return
        with self._writing():
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fdatasync(self._stream.fileno())
            self._stream.close()

    def _write_input(self, captured: Captured) -> None:
        if captured.calibration is not None and captured.calibration is not self._calibration:
            self._write(captured.calibration)
            self._calibration = captured.calibration
        if captured.image is not None:
            self._write(captured.image)
        elif isinstance(captured.frame, Frame):
            self._write_frame(captured.frame, captured.log_time_ns)

    def _write_frame(self, frame: Frame, time_ns: int) -> None:
        if frame.camera != self._camera:
            self._write(calibration_message(frame.camera, time_ns))
            self._camera = frame.camera
        self._write(image_message(gray_image(frame), time_ns, 0))

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
            self.num_bytes = self._stream.tell()

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
            raise SourceError(f"the log {self.path} is closed")
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):  # it tries to write the rest once more
                self._stream.close()
            if not self.holds_messages:
                with contextlib.suppress(OSError):
                    self.path.unlink()
            raise cannot_write(self.path, error) from error


def _open(path: Path, *, overwrite: bool) -> BinaryIO:
    """Open and lock a file, and see to it that its name survives a loss of power."""
    try:
        stream = path.open("ab" if overwrite else "xb")
    except FileExistsError:
        raise ConfigError(
            f"the log {path} exists; name another file or allow overwriting"
        ) from None
    except OSError as error:
        raise cannot_write(path, error) from error
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise ConfigError(f"another daemon is writing the log {path}; name another one") from None
    except OSError:
        pass  # a file system without locks
    with contextlib.suppress(OSError):  # not every file system can
        stream.truncate(0)
        folder = os.open(path.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)
    return stream
