"""The messages of a recording, decoded: Foxglove's (protobuf) and ROS 2's (CDR), alike."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from mcap.reader import SeekingReader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoderFactory
from mcap_ros2.decoder import DecoderFactory as RosDecoderFactory

from trigpoint.camera_messages import Calibration, Image
from trigpoint.errors import SourceError, TrigpointError
from trigpoint_db.salvage import DAMAGE

T = TypeVar("T")
RAW_IMAGES = ("foxglove.RawImage", "sensor_msgs/msg/Image")
IMAGES = ("foxglove.CompressedImage", "sensor_msgs/msg/CompressedImage", *RAW_IMAGES)
CALIBRATIONS = ("foxglove.CameraCalibration", "sensor_msgs/msg/CameraInfo")
_SCHEMA_ENCODINGS = ("protobuf", "ros2msg")
_NS = 10**9


@dataclass(frozen=True, eq=False)
class Message:
    """A message as its library decodes it."""

    topic: str
    schema: str
    log_time_ns: int  # of arrival
    content: Any

    @property
    def time_ns(self) -> int:
        """The time that it is stamped with, or else of arrival."""
        return stamp_ns(self.content) or self.log_time_ns


class Recording:
    """A recording with an index; its messages are read in the order of their arrival."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with path.open("rb") as stream:
                if path.stat().st_size == 0:  # which cannot be mapped
                    raise SourceError(f"{path} is empty")
                data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
            self._reader = SeekingReader(
                data,  # type: ignore[arg-type]
                validate_crcs=True,
                decoder_factories=(ProtobufDecoderFactory(), RosDecoderFactory()),
            )
            summary = self._reader.get_summary()
        except OSError as error:
            raise SourceError(f"cannot read {path}: {error.strerror}") from error
        except DAMAGE as error:
            raise _damage(path, error) from error
        if summary is None or not summary.chunk_indexes:
            raise SourceError(f"{path} has no index; `trigpoint-db recover` writes one with it")
        statistics = summary.statistics
        self._schemas = sorted(
            {
                (channel.topic, schema.name)
                for channel in summary.channels.values()
                if (schema := summary.schemas.get(channel.schema_id)) is not None
                and schema.encoding in _SCHEMA_ENCODINGS
                and (statistics is None or statistics.channel_message_counts.get(channel.id))
            }
        )

    def topics_of(self, schemas: Collection[str]) -> list[str]:
        """Return the topics with messages of one of these types."""
        return [topic for topic, schema in self._schemas if schema in schemas]

    def read(
        self,
        parse: Callable[[Message], T],
        topics: Collection[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[T]:
        """Yield what `parse` makes of messages that arrived from `start_ns` on, before `end_ns`."""
        try:
            for schema, channel, message, content in self._reader.iter_decoded_messages(
                topics, starting_at=start_ns, ending_before=end_ns
            ):
                name = "" if schema is None else schema.name
                yield parse(Message(channel.topic, name, message.log_time, content))
        except TrigpointError:
            raise
        # Decoders are made of the file's own schemas: what a damaged one raises, nobody can list.
        except Exception as error:
            raise _damage(self._path, error) from error


def _damage(path: Path, error: BaseException) -> SourceError:
    detail = str(error).partition("\n")[0] or type(error).__name__
    return SourceError(f"{path} cannot be read ({detail}); try `trigpoint-db recover`")


def stamp_ns(content: Any) -> int:
    """Return the time in a message, 0 where it is not set."""
    if hasattr(content, "header"):
        return int(content.header.stamp.sec * _NS + content.header.stamp.nanosec)
    return int(content.timestamp.ToNanoseconds())


def frame_of(content: Any) -> str:
    """Return the frame_id of a message, without the slash that ROS 1 put in front."""
    frame_id: str = content.header.frame_id if hasattr(content, "header") else content.frame_id
    return frame_id.removeprefix("/")


def parse_image(message: Message) -> Image:
    """Read a message of one of `IMAGES`."""
    m = message.content
    rows = (m.encoding, m.width, m.height, m.step) if message.schema in RAW_IMAGES else ()
    return Image(stamp_ns(m), frame_of(m), bytes(m.data), *rows)


def parse_calibration(message: Message) -> Calibration:
    """Read a message of one of `CALIBRATIONS`."""
    m = message.content
    # ROS 2 spells them small.
    D, K, P = (m.d, m.k, m.p) if hasattr(m, "header") else (m.D, m.K, m.P)
    return Calibration(
        frame_of(m), m.width, m.height, m.distortion_model, list(D), list(K), list(P)
    )


def image_name(message: Message) -> str:
    """Name an image in its recording, for `read_image`: the topic and the time of arrival."""
    return f"{message.topic}/{message.log_time_ns}"


def read_image(path: Path, name: str) -> Image:
    """Read one image of a recording, as it was sent."""
    topic, _, time = name.rpartition("/")
    time_ns = int(time) if time.isdecimal() else -1
    recording = _open(path)
    if topic in recording.topics_of(IMAGES):
        for image in recording.read(parse_image, [topic], time_ns, time_ns + 1):
            return image
    raise SourceError(f"{path} has no image {name}")


@lru_cache(maxsize=1)  # a map is built from one recording, whose index may be long
def _open(path: Path) -> Recording:
    return Recording(path)
