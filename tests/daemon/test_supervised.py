"""What the supervisor makes of cameras that come, go and break."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncGenerator, Sequence

import numpy as np
import pytest

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError, SourceError
from trigpoint.frame import Frame
from trigpointd.backoff import Backoff
from trigpointd.sources.base import BadFrame, Captured
from trigpointd.sources.supervised import SupervisedSource

CAMERA = Camera.from_text("PINHOLE 8 4 7 7 4 2")
GONE = SourceError("it is gone")
WRONG = ConfigError("it has another size; name the right one")
BAD = "a bad frame"
GOOD = "a good frame"
COMES = "camera X: frames come"
LOST = "camera X: it is gone; trying again"
TIMEOUT_S = 30

Stream = Sequence[str | Exception]


class ScriptedCamera:
    """Plays a stream each time that it is opened; an error ends it. After the last it hangs."""

    name = "camera X"

    def __init__(self, *streams: Stream) -> None:
        self._streams = list(streams)
        self.num_open = 0
        self.hangs = asyncio.Event()

    def describe(self) -> str:
        raise GONE

    async def frames(self) -> AsyncGenerator[Captured, None]:
        self.num_open += 1
        try:
            if not self._streams:
                self.hangs.set()
                await asyncio.Event().wait()
            for item in self._streams.pop(0):
                if isinstance(item, Exception):
                    raise item
                yield captured(good=item == GOOD)
        finally:
            self.num_open -= 1

    async def close(self) -> None:
        assert self.num_open == 0


class CountedBackoff(Backoff):
    """Delays of no length: how many were drawn between one beginning and the next."""

    def __init__(self) -> None:
        self.drawn = [0]

    def next_s(self) -> float:
        self.drawn[-1] += 1
        return 0.0

    def reset(self) -> None:
        self.drawn.append(0)


def captured(*, good: bool) -> Captured:
    if not good:
        return Captured(BadFrame(7, "X#7", "it is torn"), 7, num_missed=3)
    return Captured(Frame(np.zeros((4, 8), np.uint8), CAMERA, 7, "X#7"), 7, num_missed=3)


def kind(captured: Captured) -> str:
    return GOOD if isinstance(captured.frame, Frame) else captured.frame.reason


async def play(camera: ScriptedCamera, source: SupervisedSource) -> list[Captured]:
    """Take what comes until the script is at its end."""
    taken: list[Captured] = []

    async def consume() -> None:
        async with contextlib.aclosing(source.frames()) as frames:
            while True:
                taken.append(await anext(frames))

    async with asyncio.timeout(TIMEOUT_S):
        task = asyncio.create_task(consume())
        hangs = asyncio.create_task(camera.hangs.wait())
        await asyncio.wait([task, hangs], return_when=asyncio.FIRST_COMPLETED)
        for one in (task, hangs):
            one.cancel()
        await asyncio.wait([task, hangs])
        await source.close()
    if not task.cancelled():
        await task
    return taken


def taken_of(*streams: Stream) -> list[Captured]:
    camera = ScriptedCamera(*streams)
    return asyncio.run(play(camera, SupervisedSource(camera, backoff=Backoff(0.0))))


@pytest.fixture
def log(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO, "trigpointd")
    return caplog


def test_frames_pass_as_they_are_and_each_failed_try_says_that_there_are_none() -> None:
    taken = taken_of([GOOD, BAD, GOOD, GONE], [GONE], [GOOD])
    assert [kind(one) for one in taken[:3]] == [GOOD, "BAD_FRAME", GOOD]
    assert [kind(one) for one in taken[3:]] == ["NO_FRAMES", "NO_FRAMES", GOOD, "NO_FRAMES"]
    missing = taken[3].frame
    assert isinstance(missing, BadFrame)
    assert (missing.name, missing.detail) == ("camera X", "camera X: it is gone")
    assert missing.time_ns == taken[3].log_time_ns
    assert taken[3].num_missed == 3  # those that were lost before are not forgotten


def test_each_problem_is_said_once_until_frames_come_again(log: pytest.LogCaptureFixture) -> None:
    busy = [SourceError("no frame in 5 s")], [GONE], [SourceError("no frame in 12 s")]
    taken_of(*busy, *busy, [GOOD, GOOD, GONE], *busy, [GOOD, GOOD])
    silent = "camera X: no frame in 5 s; trying again"
    ended = "camera X: its stream ended; trying again"
    assert log.messages == [silent, LOST, COMES, LOST, silent, COMES, ended]


def test_frames_that_cannot_be_used_are_no_frames(log: pytest.LogCaptureFixture) -> None:
    taken_of([GONE], [BAD, GONE], [BAD, GONE])
    assert log.messages == [LOST]


def test_the_problem_is_there_while_frames_are_not() -> None:
    camera = ScriptedCamera([GOOD, GONE], [GONE], [BAD, GOOD])
    source = SupervisedSource(camera, backoff=Backoff(0.0))

    async def problems() -> list[str]:
        found = [source.problem]
        async with contextlib.aclosing(source.frames()) as frames:
            for _ in range(5):
                await anext(frames)
                found.append(source.problem)
        return found

    gone = "camera X: it is gone"
    assert asyncio.run(problems()) == ["", "", gone, gone, gone, ""]


def test_what_no_other_try_would_help_ends_it_before_the_first_usable_frame() -> None:
    with pytest.raises(ConfigError, match=r"^camera X: it has another size; name the right one$"):
        taken_of([GONE], [BAD, WRONG], [GOOD])


def test_after_the_first_usable_frame_it_is_a_problem_like_others(
    log: pytest.LogCaptureFixture,
) -> None:
    taken = taken_of([GOOD, GONE], [WRONG], [WRONG], [GOOD])
    assert [kind(one) for one in taken].count(GOOD) == 2
    assert log.messages[:4] == [
        COMES,
        LOST,
        "camera X: it has another size; name the right one; trying again",
        COMES,
    ]


def test_a_bug_is_outlived_and_logged_once_with_its_traceback(
    log: pytest.LogCaptureFixture,
) -> None:
    bug = ZeroDivisionError("division\nby zero")
    taken = taken_of([bug], [bug], [GOOD, bug], [GOOD])
    assert [kind(one) for one in taken].count(GOOD) == 2
    said = "camera X: ZeroDivisionError: division by zero; trying again"
    assert log.messages[:4] == [said, COMES, said, COMES]
    traced = [record.message for record in log.records if record.exc_info]
    assert traced == [said, said]


@pytest.mark.parametrize(("lasting_s", "drawn"), [(0.0, [3, 2, 1]), (3600.0, [6])])
def test_delays_begin_anew_after_a_stream_that_lasted(lasting_s: float, drawn: list[int]) -> None:
    camera = ScriptedCamera(
        [GONE], [GONE], [GOOD, GONE], [GOOD, GOOD, GONE], [BAD, BAD, GONE], [GOOD, GOOD, GONE]
    )
    backoff = CountedBackoff()
    asyncio.run(play(camera, SupervisedSource(camera, backoff=backoff, lasting_s=lasting_s)))
    assert backoff.drawn == drawn


def test_the_end_comes_at_once_between_two_tries_and_in_a_stream() -> None:
    async def scenario(camera: ScriptedCamera, *awaited: str) -> None:
        source = SupervisedSource(camera, backoff=Backoff(3600.0, 3600.0))
        async with asyncio.timeout(TIMEOUT_S), contextlib.aclosing(source.frames()) as frames:
            for expected in awaited:
                assert kind(await anext(frames)) == expected
            following = asyncio.ensure_future(anext(frames))
            await asyncio.sleep(0)
            following.cancel()
            with pytest.raises(asyncio.CancelledError):
                await following
        await source.close()

    asyncio.run(scenario(ScriptedCamera([GOOD, GONE]), GOOD, "NO_FRAMES"))
    asyncio.run(scenario(ScriptedCamera()))


def test_a_description_names_the_camera() -> None:
    with pytest.raises(SourceError, match=r"^camera X: it is gone$"):
        SupervisedSource(ScriptedCamera()).describe()
