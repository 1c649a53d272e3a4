"""A live view: what a log holds, to viewers that connect; it needs the extra `foxglove`."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from typing import Any

from trigpoint.errors import ConfigError
from trigpoint.frame import Frame
from trigpointd.config import FoxgloveConfig
from trigpointd.messages.foxglove import calibration_message, gray_image, image_message
from trigpointd.messages.published import Published
from trigpointd.messages.visuals import Visuals
from trigpointd.pipeline import Output
from trigpointd.sources.base import Captured, Channel, Message

_log = logging.getLogger(__name__)
_BACKLOG = 40  # messages, some four frames', that wait for a slow viewer; then the oldest go


class FoxgloveSink:
    """Serves Foxglove's WebSocket protocol.

    Messages are made and sent by a thread of its own, of the newest output alone, and only while
    somebody looks. None waits for a viewer.
    """

    def __init__(self, config: FoxgloveConfig, base_key: str) -> None:
        self.problem = ""
        self._sdk = import_sdk()
        self._context = self._sdk.Context()
        try:
            self._server = self._sdk.start_server(
                name=base_key,
                host=config.host,
                port=config.port,
                context=self._context,
                message_backlog_size=_BACKLOG,
            )
        except RuntimeError as error:
            raise ConfigError(
                f"cannot serve a live view on {config.host}:{config.port}: {error}; is the port in "
                "use by another program, or foxglove.host mistyped?"
            ) from error
        self._published, self._visuals = Published(base_key), Visuals(base_key)
        self._channels: dict[Channel, Any] = {}
        self._changed = threading.Condition()
        self._newest: Output | None = None
        self._ending = False
        self._thread = threading.Thread(target=self._work, name="foxglove", daemon=True)
        self._thread.start()

    def publish(self, output: Output) -> None:
        """Leave an output to the thread, in place of one that still waits."""
        with self._changed:
            self._newest = output
            self._changed.notify_all()

    def close(self) -> None:
        """Send what waits, and close the connections."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        self._server.stop()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._ending)
                output, self._newest = self._newest, None
            if output is None:
                return
            try:
                if self._is_watched():
                    self._send(output)
                self.problem = ""
            except Exception as error:
                if not self.problem:
                    _log.exception("the live view fails; the rest goes on")
                self.problem = str(error) or type(error).__name__

    def _is_watched(self) -> bool:
        """Whether anybody subscribes; nobody can before the first output made the channels."""
        channels = self._channels.values()
        return not channels or any(channel.has_sinks() for channel in channels)

    def _send(self, output: Output) -> None:
        for message in (
            *_input(output.captured),
            *self._published.of(output),
            *self._visuals.draw(output),
        ):
            if message.channel not in self._channels:
                self._channels[message.channel] = self._open(message.channel)
            self._channels[message.channel].log(message.data, log_time=message.log_time_ns)

    def _open(self, channel: Channel) -> Any:
        schema = None
        if channel.schema_name:
            schema = self._sdk.Schema(
                name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema
            )
        return self._sdk.Channel(
            channel.topic,
            schema=schema,
            message_encoding=channel.message_encoding,
            context=self._context,
        )


def import_sdk() -> Any:
    """Return the package `foxglove`, or say how to install it."""
    try:
        import foxglove
    except ImportError as error:
        raise ConfigError(
            f"a live view needs the package foxglove-sdk ({error}); install it with "
            "pip install 'trigpoint[foxglove]'"
        ) from error
    return foxglove


def _input(captured: Captured) -> Iterator[Message]:
    """Return calibration and image; both each time, for viewers come and go."""
    if captured.image is not None:
        if captured.calibration is not None:
            yield captured.calibration
        yield captured.image
    elif isinstance(captured.frame, Frame):
        yield calibration_message(captured.frame.camera, captured.log_time_ns)
        yield image_message(gray_image(captured.frame), captured.log_time_ns, 0)
