"""Map files that appear under their names once they are whole."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from trigpoint.database.reader import MapReader
from trigpoint.database.snapshot import put_in_place, reporting
from trigpoint.database.writer import MapWriter, keep_writers_out
from trigpoint.errors import DatabaseError
from trigpoint.frame import ModelIdentity


@contextmanager
def new_map(path: Path, model: ModelIdentity) -> Iterator[MapWriter]:
    """Write a map that is there when it is complete; one that is there already is an error."""
    _refuse_existing(path)
    with _partial_file(path) as partial:
        try:
            with MapWriter.create(partial, model) as writer:
                yield writer
        except DatabaseError as error:
            raise DatabaseError(str(error).replace(str(partial), str(path))) from error
        _refuse_existing(path)
        partial.rename(path)


def partial_map(path: Path) -> Path:
    """Name the file in which a map grows that `resumable_map` makes."""
    return path.with_name(path.name + ".partial")


@contextmanager
def resumable_map(path: Path, model: ModelIdentity, *, resume: bool) -> Iterator[MapWriter]:
    """Write a map that is there when it is complete, and whose commits outlive the process.

    They stay in `partial_map`, a map of its own. With `resume` the writer goes on with them;
    without, they are an error.
    """
    _refuse_existing(path)
    partial = partial_map(path)
    with _open_partial(partial, model) as writer:
        if len(writer) and not resume:
            raise DatabaseError(
                f"{partial} holds {len(writer)} images of a build that was interrupted; go on with "
                "--resume, or remove it"
            )
        try:
            yield writer
        except BaseException:
            if writer.generation == 0:  # nothing to go on with
                _remove_map(partial)
            raise
    _refuse_existing(path)
    partial.rename(path)
    _remove_map(partial)


def _open_partial(partial: Path, model: ModelIdentity) -> MapWriter:
    if partial.exists():
        return MapWriter.open(partial, model)
    return MapWriter.create(partial, model)


def compact_map(path: Path) -> None:
    """Rewrite a map without the pages that no image needs any more, as LMDB does.

    The new file takes the place of the old one when it is on disk. Readers keep the old one until
    they refresh; other writers are turned away meanwhile. A damaged map is an error.
    """
    path = path.resolve()  # the file itself is replaced, not a link to it
    with MapReader.open(path) as reader:
        problems = reader.verify()
        model = reader.model
    if problems:
        raise DatabaseError(f"{path}: is damaged and stays as it is: {problems[0]}")
    with closing(MapWriter.open(path, model)) as writer, _partial_file(path) as partial:
        writer.copy_to(partial)
        put_in_place(partial, path)


@contextmanager
def rewritten_map(path: Path) -> Iterator[tuple[MapReader, MapWriter]]:
    """Write a map anew, from what it holds; it takes the place of the old one when it is complete.

    Its readers keep the old one until they refresh; other writers are turned away meanwhile.
    """
    path = path.resolve()  # the file itself is replaced, not a link to it
    with ExitStack() as stack:
        reader = stack.enter_context(MapReader.open(path))
        stack.enter_context(closing(MapWriter.open(path, reader.model)))
        partial = stack.enter_context(_partial_file(path))
        with MapWriter.create(partial, reader.model) as writer:
            yield reader, writer
        put_in_place(partial, path)


def install_map(new: Path, path: Path) -> None:
    """Put a whole map in the place of another one, or of none; on disk when this returns.

    Readers keep the old one until they refresh. A new one that is damaged is an error, and so is an
    old one that a writer has open; the old one stays then.
    """
    path = path.resolve()
    with MapReader.open(new) as reader:
        if problems := reader.verify():
            raise DatabaseError(f"{new}: is damaged and is not taken: {problems[0]}")
    with reporting(path), ExitStack() as stack:
        if path.exists():
            old = os.open(path, os.O_RDONLY)
            stack.callback(os.close, old)
            keep_writers_out(old)
        _sync(new)
        put_in_place(new, path)
        _sync(path.parent)
    _remove_map(new)  # its lock file


def _sync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise DatabaseError(
            f"{path} exists; name another file, remove it, or add to it: trigpoint-db build "
            "--append"
        )


@contextmanager
def _partial_file(path: Path) -> Iterator[Path]:
    """Name a file beside a map for its making; no such file stays, nor those of killed processes.

    Each process has one of its own, so that two at once do not meet.
    """
    for leftover in path.parent.glob(f"{glob.escape(path.name)}.*.partial*"):  # lock files too
        owner = leftover.name.removeprefix(path.name + ".").partition(".")[0]
        if owner.isdecimal() and not Path("/proc", owner).exists():
            _remove(leftover)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        yield partial
    finally:
        _remove_map(partial)


def _remove_map(path: Path) -> None:
    _remove(path)
    _remove(path.with_name(path.name + "-lock"))


def _remove(leftover: Path) -> None:
    with suppress(OSError):
        leftover.unlink()
