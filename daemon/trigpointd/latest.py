"""A place for one item between a producer that may be faster and a consumer that may be slower."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """Holds one item; the newest wins, and what it pushes out is counted.

    With `lossless` a producer waits until the item before has been taken.
    """

    def __init__(self, *, lossless: bool) -> None:
        self.lossless = lossless
        self.num_dropped = 0
        self._items: list[T] = []
        self._closed = False
        self._changed = asyncio.Condition()

    async def put(self, item: T) -> None:
        """Leave an item for the consumer."""
        async with self._changed:
            if self.lossless:
                await self._changed.wait_for(lambda: not self._items)
            self.num_dropped += len(self._items)
            self._items[:] = [item]
            self._changed.notify_all()

    async def wait(self) -> bool:
        """Wait for an item without taking it; False once closed and empty."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._items or self._closed)
            return bool(self._items)

    async def get(self) -> T | None:
        """Take the item, waiting for one; None once closed and empty."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._items or self._closed)
            item = self._items.pop() if self._items else None
            self._changed.notify_all()
            return item

    async def close(self) -> None:
        """Say that no item will follow."""
        async with self._changed:
            self._closed = True
            self._changed.notify_all()
