"""A published map, fetched chunk by chunk into a file beside the old one, which it then replaces.

Each chunk is known by its hash. So whatever is there already, of an attempt that was cut short or
of the old map, is found by hashing and not fetched again, and no state beside the file is needed.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol, Self

from trigpoint.database.replacing import install_map
from trigpoint.database.snapshot import reporting, require_in_place
from trigpoint.database.writer import keep_writers_out, let_writers_in
from trigpoint.errors import ConfigError, SourceError
from trigpoint_db.fleet.manifest import Manifest, hash_file, hash_whole

_NUM_IN_WORK = 4  # chunks
_MAX_LIES = 3  # of one chunk, of one manifest
_MAX_DELAY_S = 2.0

Track = Callable[[Iterable[int], str, int], Iterable[int]]


class Remote(Protocol):
    """A published map."""

    key: str

    def get_manifest(self, timeout_s: float) -> Manifest | None:
        """Ask for the manifest; None where nobody answers."""
        ...

    def get_chunk(self, sha256: str) -> list[bytes | None]:
        """Ask for a chunk; a publisher that does not have it answers None."""
        ...

    def cancel(self) -> None:
        """Wait for no chunk any more, until the manifest is asked for again."""
        ...


class _StaleManifestError(Exception):
    """The publisher does not have a chunk: it has another map by now."""


@dataclass(frozen=True)
class Fetched:
    """What came of a fetch."""

    manifest: Manifest
    num_bytes_fetched: int
    is_new: bool  # else the map was up to date


def partial_fetch(path: Path) -> Path:
    """Name the file that a map is fetched into."""
    return path.with_name(path.name + ".fetch")


def fetch_map(remote: Remote, path: Path, *, patience_s: float, track: Track) -> Fetched:
    """Make a file the map that is published; the old one stays until all of the new one is there.

    Waits for a publisher that is away, for `patience_s` at the most.
    """
    sizes = list[int]()  # of the chunks that came
    lies = Counter[str]()
    while True:
        manifest = _ask_for_manifest(remote, _Patience(remote.key, patience_s))
        if _is_same(path, manifest):
            return Fetched(manifest, sum(sizes), is_new=False)
        try:
            with _Partial(path, manifest) as partial:
                _fetch_chunks(remote, partial, _Patience(remote.key, patience_s), track, sizes)
                partial.install()
                return Fetched(manifest, sum(sizes), is_new=True)
        except _StaleManifestError as error:
            lies[manifest.sha256] += 1
            if lies[manifest.sha256] == _MAX_LIES:
                raise SourceError(
                    f"what is announced on {remote.key} is not to be had there, {_MAX_LIES} times; "
                    "let only one publisher have that key, and restart it"
                ) from error
            if lies[manifest.sha256] > 1:  # at first it has just moved on
                time.sleep(_MAX_DELAY_S)


def _is_same(path: Path, manifest: Manifest) -> bool:
    if not path.is_file() or (status := path.stat()).st_size != manifest.num_bytes:
        return False
    state = status.st_dev, status.st_ino, status.st_size, status.st_ctime_ns
    return _hash_once(path, state) == manifest.sha256


@lru_cache(maxsize=1)
def _hash_once(path: Path, _state: tuple[int, ...]) -> str:
    """Hash a file, again only when its state is another one: `--watch` asks for ever."""
    return hash_whole(path)


class _Patience:
    """Waits between attempts, longer and longer, until nothing has come for too long."""

    def __init__(self, key: str, limit_s: float) -> None:
        self._key = key
        self._limit_s = limit_s
        self._last_s = time.monotonic()
        self._is_over = threading.Event()

    @property
    def left_s(self) -> float:
        return max(0.0, self._last_s + self._limit_s - time.monotonic())

    def renew(self) -> None:
        self._last_s = time.monotonic()

    def end(self) -> None:
        """Let no attempt wait any more."""
        self._is_over.set()

    def attempts(self) -> Iterator[None]:
        delay_s = 0.05
        while True:
            yield
            self._require()
            self._is_over.wait(delay_s)
            delay_s = min(2 * delay_s, _MAX_DELAY_S)

    def wait_for(self, future: Future[None]) -> None:
        """Wait for one of those who attempt; what the others get is reason to wait longer."""
        while wait([future], min(self.left_s, threading.TIMEOUT_MAX)).not_done:
            self._require()
        future.result()

    def _require(self) -> None:
        if self._is_over.is_set() or not self.left_s:
            raise SourceError(
                f"nothing came on {self._key} for {self._limit_s:g} s; is `trigpoint-db publish` "
                "running, and reached by --connect? What has come is kept: the same command goes on"
            )


def _ask_for_manifest(remote: Remote, patience: _Patience) -> Manifest:
    for _ in patience.attempts():
        manifest = remote.get_manifest(patience.left_s)
        if manifest is not None:
            return manifest
    raise AssertionError  # `attempts` ends with an error only


def _fetch_chunks(
    remote: Remote, partial: _Partial, patience: _Patience, track: Track, sizes: list[int]
) -> None:
    def fetch(chunk: int) -> None:
        data = _fetch_chunk(remote, partial.manifest, chunk, patience)
        partial.write(chunk, data)
        sizes.append(len(data))

    with ThreadPoolExecutor(_NUM_IN_WORK) as executor:
        try:
            futures = {chunk: executor.submit(fetch, chunk) for chunk in partial.missing}
            for chunk in track(partial.missing, "fetching", len(partial.missing)):
                patience.wait_for(futures[chunk])
        finally:  # before the executor waits for its threads
            executor.shutdown(wait=False, cancel_futures=True)
            patience.end()
            remote.cancel()


def _fetch_chunk(remote: Remote, manifest: Manifest, chunk: int, patience: _Patience) -> bytes:
    digest, num_lies = manifest.chunks[chunk], 0
    for _ in patience.attempts():
        answers = remote.get_chunk(digest)
        for answer in answers:
            if answer is not None and hashlib.sha256(answer).hexdigest() == digest:
                patience.renew()
                return answer
        if answers and all(answer is None for answer in answers):
            raise _StaleManifestError
        num_lies += bool(answers)
        if num_lies == _MAX_LIES:
            raise SourceError(
                f"chunk {chunk} of {remote.key} does not have the hash of its manifest, "
                f"{_MAX_LIES} times; restart the publisher, and check its disk"
            )
    raise AssertionError  # `attempts` ends with an error only


class _Partial:
    """The file that grows, of its full size from the beginning; other fetches are kept out."""

    def __init__(self, path: Path, manifest: Manifest) -> None:
        self.manifest = manifest
        self._target = path.resolve()
        self._path = partial_fetch(self._target)
        with reporting(self._path), ExitStack() as undo:
            self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
            undo.callback(let_writers_in, self._fd)
            keep_writers_out(self._fd)
            require_in_place(self._path, self._fd)
            is_new = os.fstat(self._fd).st_size == 0
            try:
                self._reserve()
            except ConfigError:
                if is_new:  # nothing to go on with
                    self._path.unlink()
                raise
            lacking = set(range(len(manifest.chunks)))
            lacking -= self._find_own()
            lacking -= self._copy_from_old(lacking)
            self.missing = sorted(lacking)
            self._undo = undo.pop_all()

    def _reserve(self) -> None:
        """Take the disk space before anything is fetched."""
        wanted, status = self.manifest.num_bytes, os.fstat(self._fd)
        free = shutil.disk_usage(self._path.parent).free + 512 * status.st_blocks
        full = ConfigError(
            f"{self._target}: the new map needs {wanted / 1e6:.1f} MB beside the old one, and "
            f"{free / 1e6:.1f} MB are free; make room there"
        )
        try:
            if free < wanted:
                raise full
            os.ftruncate(self._fd, wanted)
            os.posix_fallocate(self._fd, 0, wanted)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise
            raise full from error

    def _find_own(self) -> set[int]:
        hashes = hash_file(self._fd, self.manifest.chunk_bytes).chunks
        wanted = enumerate(zip(hashes, self.manifest.chunks, strict=True))
        return {chunk for chunk, (own, digest) in wanted if own == digest}

    def _copy_from_old(self, lacking: set[int]) -> set[int]:
        """Copy what the old map has of the new one; a daemon may be changing it meanwhile."""
        found: set[int] = set()
        if not lacking or not self._target.is_file():
            return found
        with self._target.open("rb", buffering=0) as old:
            while data := old.read(self.manifest.chunk_bytes):
                places = self.manifest.places.get(hashlib.sha256(data).hexdigest(), ())
                for chunk in lacking.intersection(places):
                    self.write(chunk, data)
                    found.add(chunk)
        return found

    def write(self, chunk: int, data: bytes) -> None:
        os.pwrite(self._fd, data, chunk * self.manifest.chunk_bytes)

    def install(self) -> None:
        """Check the whole, and put it in the place of the old map, with its owner and mode."""
        with reporting(self._path):
            sha256 = hash_whole(self._path)
        if sha256 != self.manifest.sha256:
            self._path.unlink()
            raise SourceError(
                f"{self._path}: the whole does not have the hash of its manifest; restart the "
                "publisher"
            )
        with reporting(self._target):
            if self._target.exists():
                status = self._target.stat()
                os.fchmod(self._fd, stat.S_IMODE(status.st_mode))
                if (status.st_uid, status.st_gid) != (os.geteuid(), os.getegid()):
                    os.fchown(self._fd, status.st_uid, status.st_gid)
        install_map(self._path, self._target)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()
