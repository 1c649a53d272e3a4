"""The log as a sink: in a thread of its own, so that no disk holds up the localizer."""

from __future__ import annotations

import logging
import threading
from collections import deque

from trigpoint.frame import Frame
from trigpointd.pipeline import Output
from trigpointd.sinks.rolling_log import RollingLog

_log = logging.getLogger(__name__)
_QUEUE_BYTES = 32_000_000
_CLOSE_S = 1.5  # a disk that hangs must not hold up the end


class Recorder:
    """Hands outputs to a log, and never fails.

    They wait in a queue of `_QUEUE_BYTES`. Where the disk is slower than the camera for longer than
    that lasts, outputs are left out and counted; with `lossless`, for recordings, the caller waits.
    """

    def __init__(self, log: RollingLog, *, lossless: bool = False) -> None:
        self._log, self._lossless = log, lossless
        self._changed = threading.Condition()
        self._queue: deque[Output] = deque()
        self._queued_bytes = 0  # with what is being written
        self._num_dropped = 0
        self._behind = self._ending = False
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def publish(self, output: Output) -> None:
        """Leave an output to the thread."""
        with self._changed:
            if self._lossless:
                self._changed.wait_for(lambda: self._queued_bytes < _QUEUE_BYTES)
            elif self._queued_bytes >= _QUEUE_BYTES:
                self._drop()
                return
            self._queue.append(output)
            self._queued_bytes += _num_bytes(output)
            self._changed.notify_all()

    @property
    def problem(self) -> str:
        """Why recording pauses or leaves out frames; empty while it does not."""
        return self._log.problem or ("the disk is too slow" if self._behind else "")

    @property
    def num_unlogged(self) -> int:
        """How many frames are not in the log so far."""
        return self._num_dropped + self._log.num_unlogged

    def close(self) -> None:
        """Write what waits, and the index; a disk that hangs is left alone after `_CLOSE_S`."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join(None if self._lossless else _CLOSE_S)
        if self._thread.is_alive():
            _log.error("the disk is too slow to finish the log; `trigpoint-db recover` can")
        if self.num_unlogged:
            _log.warning("%d frames are not in the log", self.num_unlogged)

    def _drop(self) -> None:
        self._num_dropped += 1
        if not self._behind:
            _log.warning("the disk is too slow for the log; frames are left out of it")
        self._behind = True

    def _work(self) -> None:
        while True:
            timeout_s = self._log.time_to_flush_s
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._ending, timeout_s)
                output = self._queue.popleft() if self._queue else None
            if output is not None:
                self._log.write(output)
                self._written(output)
            elif self._ending:
                break
            else:
                self._log.flush()
        self._log.close()

    def _written(self, output: Output) -> None:
        with self._changed:
            self._queued_bytes -= _num_bytes(output)
            self._behind = self._behind and bool(self._queue)
            self._changed.notify_all()


def _num_bytes(output: Output) -> int:
    captured, frame = output.captured, output.captured.frame
    image = 0 if captured.image is None else len(captured.image.data)
    return len(output.status) + image + (frame.image.nbytes if isinstance(frame, Frame) else 0)
