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
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

from trigpoint.database.replacing import install_map
from trigpoint.database.snapshot import reporting, require_in_place
from trigpoint.database.writer import keep_writers_out, let_writers_in
from trigpoint.errors import ConfigError, SourceError
from trigpoint_db.fleet.manifest import Manifest, hash_file

_NUM_IN_WORK = 4  # chunks
_MAX_LIES = 3  # of one chunk
_MAX_DELAY_S = 2.0

Track = Callable[[Iterable[int], str, int], Iterable[int]]


class Remote(Protocol):
    """A published map."""

    key: str

    def get_manifest(self) -> Manifest | None:
        """Ask for the manifest; None where nobody answers."""
        ...

    def get_chunk(self, sha256: str) -> list[bytes | None]:
        """Ask for a chunk; a publisher that does not have it answers None."""
        ...


class _StaleManifestError(Exception):
    """The publisher has another map by now."""


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
    while True:
        patience = _Patience(remote.key, patience_s)
        manifest = _ask_for_manifest(remote, patience)
        if _is_same(path, manifest):
            return Fetched(manifest, 0, is_new=False)
        try:
            with _Partial(path, manifest) as partial:
                missing = partial.missing
                _fetch_chunks(remote, partial, patience, track)
                partial.install()
                num_bytes = sum(manifest.size_of(chunk) for chunk in missing)
                return Fetched(manifest, num_bytes, is_new=True)
        except _StaleManifestError:
            continue


def _is_same(path: Path, manifest: Manifest) -> bool:
    if not path.is_file() or path.stat().st_size != manifest.num_bytes:
        return False
    with path.open("rb") as file:
        return hash_file(file.fileno()).sha256 == manifest.sha256


class _Patience:
    """Waits between attempts, longer and longer, until nothing has come for too long."""

    def __init__(self, key: str, limit_s: float) -> None:
        self._key = key
        self._limit_s = limit_s
        self._last_s = time.monotonic()
        self._is_over = threading.Event()

    def renew(self) -> None:
        self._last_s = time.monotonic()

    def end(self) -> None:
        """Let no attempt wait any more."""
        self._is_over.set()

    def attempts(self) -> Iterator[None]:
        delay_s = 0.05
        while not self._is_over.is_set():
            yield
            if time.monotonic() - self._last_s > self._limit_s:
                break
            self._is_over.wait(delay_s)
            delay_s = min(2 * delay_s, _MAX_DELAY_S)
        raise SourceError(
            f"nothing came on {self._key} for {self._limit_s:g} s; is `trigpoint-db publish` "
            "running, and reached by --connect? What has come is kept: the same command goes on"
        )


def _ask_for_manifest(remote: Remote, patience: _Patience) -> Manifest:
    for _ in patience.attempts():
        manifest = remote.get_manifest()
        if manifest is not None:
            patience.renew()
            return manifest
    raise AssertionError  # `attempts` ends with an error only


def _fetch_chunks(remote: Remote, partial: _Partial, patience: _Patience, track: Track) -> None:
    def fetch(chunk: int) -> int:
        partial.write(chunk, _fetch_chunk(remote, partial.manifest, chunk, patience))
        return chunk

    with ThreadPoolExecutor(_NUM_IN_WORK) as executor, ExitStack() as at_end:
        at_end.callback(patience.end)
        fetched = executor.map(fetch, partial.missing)
        for _ in track(fetched, "fetching", len(partial.missing)):
            pass


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
        if hash_file(self._fd).sha256 != self.manifest.sha256:
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
