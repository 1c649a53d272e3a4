"""Requests between the network's threads, which must not wait, and the loop that answers them."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from trigpoint.errors import RequestError
from trigpointd.config import RequestsConfig
from trigpointd.requests import Answer, Request

_log = logging.getLogger(__name__)
_BURST_S = 1.0  # so far ahead of its rate may a kind of request be

Reply = Callable[[Answer], None]


class RequestQueue:
    """A bounded queue: what is too large, too often or too much is refused at once.

    Parameters
    ----------
    limits : RequestsConfig
    answer : callable
        Answers one request; called from one thread at a time.
    clock : callable
        Seconds, monotonic.
    """

    def __init__(
        self,
        limits: RequestsConfig,
        answer: Callable[[Request], Answer],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._limits = limits
        self._answer = answer
        self._clock = clock
        self._lock = threading.Lock()
        self._waiting: deque[tuple[Request, Reply]] = deque()
        self._due_s: dict[str, float] = {}  # when a kind's requests so far are due at its rate
        self._loop: asyncio.AbstractEventLoop | None = None
        self._arrived = asyncio.Event()
        self._is_closed = False

    def put(self, request: Request, reply: Reply) -> None:
        """Let a request wait for its answer, or refuse it; from any thread."""
        with self._lock:
            self._admit(request)
            self._waiting.append((request, reply))
            self._wake()

    async def serve(self, turn: asyncio.Lock) -> None:
        """Answer requests until the queue is closed, each in a turn of its own."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
        while not self._is_closed:
            if not self._waiting:
                self._arrived.clear()
                await self._arrived.wait()
                continue
            async with turn:
                with self._lock:
                    if not self._waiting:  # closed meanwhile
                        break
                    request, reply = self._waiting.popleft()
                answer = await asyncio.to_thread(self._answer, request)
            try:
                await asyncio.to_thread(reply, answer)
            except Exception:  # one that cannot be sent must not cost the others theirs
                _log.exception("an answer could not be sent")
        with self._lock:
            self._loop = None

    def close(self) -> None:
        """Refuse what waits and what comes."""
        with self._lock:
            self._is_closed = True
            waiting = list(self._waiting)
            self._waiting.clear()
            self._wake()
        for _, reply in waiting:
            reply(Answer(b"the daemon is stopping", is_error=True))

    def _wake(self) -> None:
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._arrived.set)

    def _admit(self, request: Request) -> None:
        limits = self._limits
        if self._is_closed:
            raise RequestError("the daemon is stopping")
        if len(request.payload) > limits.max_payload_bytes:
            raise RequestError(
                f"the payload has {len(request.payload)} bytes; at most "
                f"{limits.max_payload_bytes} are accepted"
            )
        if len(self._waiting) >= limits.max_waiting:
            raise RequestError(f"busy: {len(self._waiting)} requests are waiting; ask again later")
        now = self._clock()
        due = max(self._due_s.get(request.kind, now), now)
        if due - now > _BURST_S:
            raise RequestError(
                f"busy: at most {limits.max_rate_hz:g} {request.kind} requests a second are "
                "answered; ask again later"
            )
        self._due_s[request.kind] = due + 1 / limits.max_rate_hz
