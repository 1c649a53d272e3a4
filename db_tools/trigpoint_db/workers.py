"""Work on many images at once, by processes here or on other machines, with results in order."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from multiprocessing.connection import Connection
from typing import Protocol, Self, TypeVar, cast

from trigpoint.errors import SourceError, TrigpointError

Item = TypeVar("Item")
Result = TypeVar("Result")

_MAX_DEATHS = 3  # of workers that have nothing but one item to do


class Workers(Protocol):
    """Those who do the work."""

    num_threads: int  # of a network, so that all together have one a core
    max_in_work: int  # items handed out at a time: their bytes are in memory
    deaths: tuple[type[Exception], ...]  # what a future says of a worker that has died

    def submit(self, work: Callable[[Item], Result], item: Item) -> Future[Result]:
        """Have one of them do it."""
        ...


class WorkerDiedError(Exception):
    """A process has ended while it worked."""


class Processes:
    """Workers on this machine. A context: at its end they are gone.

    They are spawned: OpenCV hangs in a fork of a process with threads. Each has a pipe of its own
    and a thread that waits for it; a `ProcessPoolExecutor`, whose workers share one, hangs where
    one of them is killed while it writes its result.
    """

    deaths: tuple[type[Exception], ...] = (WorkerDiedError,)

    def __init__(self, number: int) -> None:
        self.num_threads = max(1, len(os.sched_getaffinity(0)) // number)
        self.max_in_work = 2 * number
        self._threads = ThreadPoolExecutor(number)
        self._idle: list[_Process] = []
        self._started: list[_Process] = []
        self._lock = threading.Lock()
        self._is_over = False

    def submit(self, work: Callable[[Item], Result], item: Item) -> Future[Result]:
        """Have one of them do it; one that has died is replaced."""
        return self._threads.submit(self._do, work, item)

    def _do(self, work: Callable[[Item], Result], item: Item) -> Result:
        process = self._take()
        try:
            return process.do(work, item)
        finally:
            if process.is_alive:
                self._idle.append(process)

    def _take(self) -> _Process:
        with self._lock:
            if self._is_over:
                raise WorkerDiedError
            if self._idle:
                return self._idle.pop()
            self._started = [process for process in self._started if process.is_alive]
            process = _Process()
            self._started.append(process)
            return process

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._is_over = True
            for process in self._started:
                process.kill()
        self._threads.shutdown(cancel_futures=True)


class _Process:
    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=[theirs], daemon=True)
        self._process.start()
        theirs.close()

    @property
    def is_alive(self) -> bool:
        return self._process.is_alive()

    def do(self, work: Callable[[Item], Result], item: Item) -> Result:
        try:
            self._pipe.send((work, item))
            result, error = pickle.loads(self._pipe.recv_bytes())
        except (EOFError, OSError) as error:
            self.kill()
            raise WorkerDiedError from error
        if error is not None:
            raise error
        return cast("Result", result)

    def kill(self) -> None:
        self._process.kill()
        self._process.join()


def _serve(pipe: Connection) -> None:
    """Work until the process at the other end closes its pipe, or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for that one
    with suppress(EOFError, OSError, MemoryError):
        while True:
            pipe.send_bytes(_answer(*pipe.recv()))


def _answer(work: Callable[[Item], Result], item: Item) -> bytes:
    """Pickle a result, or the error to be raised in its place at the other end."""
    try:
        return pickle.dumps((work(item), None))
    except (TrigpointError, OSError) as error:
        return pickle.dumps((None, error))
    except MemoryError:  # another process may have more
        raise
    except Exception:  # which may not be one that can be pickled
        return pickle.dumps((None, RuntimeError(traceback.format_exc())))


def do_in_order(
    work: Callable[[Item], Result], items: Iterable[Item], workers: Workers
) -> Iterator[Result]:
    """Yield the results in the order of the items, whose `str` names them in errors.

    Where a worker dies, which of the items in work was the reason is not known: the first of them
    is done with no other beside it, then all that are lost again. One that has ended several
    workers all by itself is an error.
    """
    rest = iter(items)
    in_work: deque[tuple[Item, Future[Result]]] = deque()
    try:
        while True:
            for item in islice(rest, workers.max_in_work - len(in_work)):
                in_work.append((item, workers.submit(work, item)))
            if not in_work:
                return
            item, future = in_work.popleft()
            try:
                result = future.result()
            except workers.deaths:
                lost = [isinstance(f.exception(), workers.deaths) for _, f in in_work]
                result = _do_alone(work, item, workers)
                in_work = deque(
                    (other, workers.submit(work, other) if is_lost else done)
                    for (other, done), is_lost in zip(in_work, lost, strict=True)
                )
            yield result
    finally:
        for _, future in in_work:
            future.cancel()


def _do_alone(work: Callable[[Item], Result], item: Item, workers: Workers) -> Result:
    deaths: list[Exception] = []
    while len(deaths) < _MAX_DEATHS:
        try:
            return workers.submit(work, item).result()
        except workers.deaths as error:
            deaths.append(error)
    raise SourceError(
        f"{item}: {_MAX_DEATHS} processes ended while they worked on it alone, killed or out of "
        "memory; leave it out, or give them more memory"
    ) from deaths[-1]
