"""What a generator yields in a thread, for the event loop."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable, Generator
from typing import Any, TypeVar

T = TypeVar("T")


async def read_ahead(
    items: Generator[T, None, None], stop: Callable[[], object] = lambda: None
) -> AsyncGenerator[T, None]:
    """Yield what a blocking generator yields; it works on the next while one is in use.

    `stop` makes it end soon where it may block for long. However often we are cancelled, the thread
    has let go of the generator, and this is closed, when the iteration ends.
    """
    loop = asyncio.get_running_loop()
    # A future rather than a task: cancelling us must not abandon a thread that is still at work.
    ahead = loop.run_in_executor(None, next, items, None)
    try:
        while True:
            await asyncio.wait([ahead])
            item = ahead.result()
            if item is None:
                return
            ahead = loop.run_in_executor(None, next, items, None)
            yield item
    finally:
        stop()
        try:
            await _finish(ahead)
        finally:
            await _finish(loop.run_in_executor(None, items.close))


async def _finish(future: asyncio.Future[Any]) -> None:
    """Wait for a future, whatever comes of it; being cancelled meanwhile counts afterwards."""
    cancelled: asyncio.CancelledError | None = None
    while not future.done():
        try:
            await asyncio.wait([future])
        except asyncio.CancelledError as error:
            cancelled = error
    with contextlib.suppress(Exception):
        future.result()
    if cancelled is not None:
        raise cancelled
