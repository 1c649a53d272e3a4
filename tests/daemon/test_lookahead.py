"""What happens in the thread beneath a source, whatever becomes of who waits for it."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Generator

import pytest

from trigpoint.errors import SourceError
from trigpointd.sources.lookahead import read_ahead

TIMEOUT_S = 30


class Slow:
    """A generator that blocks until it is let go, and tells whether it was closed."""

    def __init__(self, *before: int) -> None:
        self.blocks, self.let_go, self.closed = (threading.Event() for _ in range(3))
        self._before = before

    def items(self) -> Generator[int, None, None]:
        try:
            yield from self._before
            self.blocks.set()
            assert self.let_go.wait(TIMEOUT_S)
            yield 7
        finally:
            self.closed.set()


def test_items_come_in_order_and_the_next_is_made_while_one_is_in_use() -> None:
    slow = Slow(1, 2)

    async def scenario() -> list[int]:
        items = read_ahead(slow.items())
        taken = [await anext(items), await anext(items)]
        assert await asyncio.to_thread(slow.blocks.wait, TIMEOUT_S)  # nobody asked for a third
        slow.let_go.set()
        return taken + [item async for item in items]

    assert asyncio.run(scenario()) == [1, 2, 7]
    assert slow.closed.is_set()


def test_an_error_comes_after_what_was_before_it() -> None:
    def items() -> Generator[int, None, None]:
        yield 1
        raise SourceError("torn")

    async def scenario() -> None:
        ahead = read_ahead(items())
        assert await anext(ahead) == 1
        with pytest.raises(SourceError, match="torn"):
            await anext(ahead)

    asyncio.run(scenario())


def test_however_often_it_is_cancelled_the_thread_has_ended_when_it_has() -> None:
    slow = Slow()

    async def scenario() -> None:
        async def consume() -> None:
            async with contextlib.aclosing(read_ahead(slow.items())) as items:
                await anext(items)

        task = asyncio.create_task(consume())
        assert await asyncio.to_thread(slow.blocks.wait, TIMEOUT_S)
        for _ in range(3):
            task.cancel()
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            assert not task.done()
        slow.let_go.set()
        await asyncio.wait([task])
        assert task.cancelled()
        assert slow.closed.is_set()

    asyncio.run(scenario())


def test_it_is_told_to_stop() -> None:
    slow = Slow()

    async def scenario() -> None:
        items = read_ahead(slow.items(), stop=slow.let_go.set)
        waiting = asyncio.ensure_future(anext(items))
        assert await asyncio.to_thread(slow.blocks.wait, TIMEOUT_S)
        waiting.cancel()
        await asyncio.wait([waiting])
        assert waiting.cancelled()

    asyncio.run(scenario())
    assert slow.closed.is_set()


def test_it_may_be_left_while_an_item_is_in_use() -> None:
    slow = Slow(1)

    async def scenario() -> None:
        async with contextlib.aclosing(read_ahead(slow.items(), stop=slow.let_go.set)) as items:
            assert await anext(items) == 1

    asyncio.run(scenario())
    assert slow.closed.is_set()
