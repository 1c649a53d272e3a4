import asyncio

from trigpointd.latest import Latest


def test_of_a_live_source_the_newest_wins_and_drops_are_counted() -> None:
    async def scenario() -> tuple[int | None, int]:
        slot = Latest[int](lossless=False)
        for item in range(5):
            await slot.put(item)
        return await slot.get(), slot.num_dropped

    assert asyncio.run(scenario()) == (4, 4)


def test_of_a_recording_every_item_arrives_in_order() -> None:
    async def scenario() -> list[int]:
        slot = Latest[int](lossless=True)
        taken = []

        async def produce() -> None:
            for item in range(20):
                await slot.put(item)
            await slot.close()

        async with asyncio.TaskGroup() as group:
            group.create_task(produce())
            while (item := await slot.get()) is not None:
                taken.append(item)
        assert slot.num_dropped == 0
        return taken

    assert asyncio.run(scenario()) == list(range(20))


def test_the_last_item_is_taken_after_closing() -> None:
    async def scenario() -> list[int | None]:
        slot = Latest[int](lossless=False)
        await slot.put(7)
        await slot.close()
        return [await slot.get(), await slot.get()]

    assert asyncio.run(scenario()) == [7, None]


def test_a_waiting_consumer_wakes_when_the_slot_is_closed() -> None:
    async def scenario() -> int | None:
        slot = Latest[int](lossless=False)
        waiting = asyncio.create_task(slot.get())
        await asyncio.sleep(0)
        await slot.close()
        return await asyncio.wait_for(waiting, 5)

    assert asyncio.run(scenario()) is None
