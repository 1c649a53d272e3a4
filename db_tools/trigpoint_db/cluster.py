"""Workers of a Dask cluster. They need Trigpoint of the same version, and no files of ours."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Self, TypeVar

import dask
from distributed import Client, KilledWorker
from distributed.comm import get_address_host_port

from trigpoint.errors import ConfigError

Item = TypeVar("Item")
Result = TypeVar("Result")

_MIN_IN_WORK = 32  # so that workers that join later are not idle
_MAX_IMAGE_BYTES = "256 MiB"  # Dask warns of larger ones


class Cluster:
    """Workers of a Dask scheduler. A context: at its end the cluster is as it was.

    A worker that dies is the business of its nanny, and what it had to do the scheduler's, which
    gives up a task that several workers died of.
    """

    num_threads = 1  # Dask runs as many tasks on a worker as that has threads
    deaths: tuple[type[Exception], ...] = (KilledWorker,)

    def __init__(self, address: str, patience_s: float = 10) -> None:
        self._address = address
        dask.config.set({"distributed.admin.large-graph-warning-threshold": _MAX_IMAGE_BYTES})
        try:
            get_address_host_port(address)  # a client of none hangs when it is let go
            self._client = Client(address, timeout=patience_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"--cluster: no Dask scheduler answers at {address}; start one with `dask "
                "scheduler` and give the address that it prints, such as tcp://10.0.0.5:8786"
            ) from error
        try:
            self._client.wait_for_workers(1, timeout=patience_s)
        except TimeoutError as error:
            self._client.close()
            raise ConfigError(
                f"--cluster: the scheduler at {address} has no workers; start some with `dask "
                f"worker {address}`"
            ) from error
        self.max_in_work = max(_MIN_IN_WORK, 2 * sum(self._client.nthreads().values()))
        # What a task gives depends on more than its arguments, so Dask must not reuse it: not pure.
        self._executor = self._client.get_executor(pure=False)

    def submit(self, work: Callable[[Item], Result], item: Item) -> Future[Result]:
        """Have one of them do it."""
        future: Future[Result] = self._executor.submit(work, item)
        return future

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        self._client.close()
        if isinstance(error, CancelledError):
            raise ConfigError(
                f"--cluster: the scheduler at {self._address} has gone; start it again, and the "
                "same command with --resume (build) or --skip-existing (add) goes on"
            ) from error
        if isinstance(error, RuntimeError | ImportError):
            reason = str(error.__cause__ or error).partition("\n")[0]
            raise ConfigError(
                f"--cluster: a worker failed: {reason}; is the same version of Trigpoint installed "
                "on all machines?"
            ) from error
