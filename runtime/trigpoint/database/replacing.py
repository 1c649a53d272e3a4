"""Map files that appear under their names once they are whole."""

from __future__ import annotations

import glob
import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from trigpoint.database.codec import Profile
from trigpoint.database.index import MIN_ROWS, build_index
from trigpoint.database.pages import read_meta
from trigpoint.database.reader import MapReader
from trigpoint.database.snapshot import (
    lock_path,
    put_in_place,
    reporting,
    require_in_place,
)
from trigpoint.database.writer import MapWriter, keep_writers_out, let_writers_in
from trigpoint.errors import DatabaseError
from trigpoint.frame import ModelIdentity

COMMIT_EVERY = 100  # images of a new map; what a crash costs at the most


@contextmanager
def new_map(
    path: Path, model: ModelIdentity, profile: Profile = Profile.STANDARD
) -> Iterator[MapWriter]:
    """Write a map that is there when it is complete; one that is there already is an error."""
    require_new(path)
    with spare_file(path) as partial:
        try:
            with MapWriter.create(partial, model, profile) as writer:
                yield writer
        except DatabaseError as error:
            raise DatabaseError(str(error).replace(str(partial), str(path))) from error
        require_new(path)
        partial.rename(path)


def partial_map(path: Path) -> Path:
    """Name the file in which a map grows that `growing_map` makes."""
    return path.with_name(path.name + ".partial")


@contextmanager
def growing_map(
    path: Path, model: ModelIdentity, profile: Profile | None = None, *, resume: bool
) -> Iterator[MapWriter]:
    """Write a map whose commits outlive the process, until `name_map` gives it its name.

    They stay in `partial_map`, a map of its own. With `resume` the writer goes on with them, in
    their profile; without, they are an error.
    """
    require_new(path)
    partial = partial_map(path)
    with _open_partial(partial, model, profile or Profile.STANDARD) as writer:
        try:
            _require_begun_alike(writer, partial, profile, resume=resume)
            yield writer
            writer.commit()
        except BaseException:
            if writer.generation == 0:  # nothing to go on with
                _remove_map(partial)
            raise


def name_map(whole: Path, path: Path) -> None:
    """Give a map that has grown, or one made of it, its name; what it has grown in is removed."""
    require_new(path)
    partial = partial_map(path)
    with reporting(partial), ExitStack() as stack:
        fd = os.open(partial, os.O_RDWR)
        stack.callback(let_writers_in, fd)
        keep_writers_out(fd)
        whole.rename(path)
        _remove_map(partial)


def _require_begun_alike(
    writer: MapWriter, partial: Path, profile: Profile | None, *, resume: bool
) -> None:
    if len(writer) and not resume:
        raise DatabaseError(
            f"{partial} holds {len(writer)} images of a build that was interrupted; go on with "
            "--resume, or remove it"
        )
    if writer.profile != (profile or (writer.profile if resume else Profile.STANDARD)):
        raise DatabaseError(
            f"{partial} was begun with the {writer.profile} profile; go on with that one, or "
            "remove it"
        )


def _open_partial(partial: Path, model: ModelIdentity, profile: Profile) -> MapWriter:
    if partial.exists():
        _remove_if_empty(partial)
    if partial.exists():
        return MapWriter.open(partial, model)
    return MapWriter.create(partial, model, profile)


def _remove_if_empty(partial: Path) -> None:
    """Remove the file of a process that ended as it made it, before LMDB's first commit."""
    with reporting(partial), ExitStack() as stack:
        fd = os.open(partial, os.O_RDWR)
        stack.callback(let_writers_in, fd)
        keep_writers_out(fd)
        if not os.fstat(fd).st_size or not any(read_meta(fd, slot).commit for slot in (0, 1)):
            _remove_map(partial)


def compact_map(
    path: Path,
    *,
    profile: Profile | None = None,
    index: bool | None = None,
    track: Callable[[range], Iterable[int]] = iter,
) -> None:
    """Rewrite a map without the pages that no image needs any more.

    The new file takes the place of the old one when it is on disk. Readers keep the old one until
    they refresh; other writers are turned away meanwhile. A damaged map is an error.

    Parameters
    ----------
    path : Path
    profile : Profile, optional
        What the map spends on an image from now on; as before by default. What `compact` has left
        out does not come back: to ask for it is an error.
    index : bool, optional
        Whether it has an index; by default where it had one, or has `MIN_ROWS` images.
    track : callable, optional
        Shows progress: of images that are written anew, of the index's lists.
    """
    path = path.resolve()  # the file itself is replaced, not a link to it
    with MapReader.open(path) as reader:
        problems = reader.verify()
        model, profile_before, had_index = reader.model, reader.profile, reader.has_index
        is_indexed = had_index or len(reader) >= MIN_ROWS if index is None else index
    if problems:
        raise DatabaseError(f"{path}: is damaged and stays as it is: {problems[0]}")
    if (profile, profile_before) == (Profile.STANDARD, Profile.COMPACT):
        raise DatabaseError(
            f"{path}: is of the compact profile, and what that leaves out does not come back; "
            "rebuild it with `trigpoint-db build`"
        )
    with closing(MapWriter.open(path, model)) as writer, spare_file(path) as partial:
        if had_index or profile not in (None, profile_before):
            _rewrite(path, partial, profile or profile_before, track)
        else:
            writer.copy_to(partial)
        if is_indexed:
            build_index(partial, track)
        put_in_place(partial, path)


@contextmanager
def rewritten_map(path: Path) -> Iterator[tuple[MapReader, MapWriter]]:
    """Write a map anew, from what it holds; it takes the place of the old one when it is complete.

    It has the profile of the old one, and an index if that has. Readers keep the old one until they
    refresh; other writers are turned away meanwhile.
    """
    path = path.resolve()  # the file itself is replaced, not a link to it
    with ExitStack() as stack:
        reader = stack.enter_context(MapReader.open(path))
        stack.enter_context(closing(MapWriter.open(path, reader.model)))
        reader.refresh()  # what others have committed before we keep them out
        partial = stack.enter_context(spare_file(path))
        with _successor(path, partial, reader, reader.profile) as writer:
            yield reader, writer
        if reader.has_index:
            build_index(partial)
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
            stack.callback(let_writers_in, old)
            keep_writers_out(old)
            require_in_place(path, old)
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


@contextmanager
def _successor(path: Path, new: Path, reader: MapReader, profile: Profile) -> Iterator[MapWriter]:
    """Write a file of the same owner and mode that follows on the generation of a map."""
    with MapWriter.create(new, reader.model, profile, reader.generation) as writer:
        status = path.stat()
        os.chown(new, status.st_uid, status.st_gid)
        new.chmod(stat.S_IMODE(status.st_mode))
        yield writer


def _rewrite(
    path: Path, new: Path, profile: Profile, track: Callable[[range], Iterable[int]]
) -> None:
    """Write the images of a map to a new file, and no index."""
    with MapReader.open(path) as reader, _successor(path, new, reader, profile) as writer:
        writer.set_pose_noise(reader.pose_noise)
        for i in track(range(len(reader))):
            record = reader.record(i)
            writer.add_record(record, record.name)
            if len(writer) % COMMIT_EVERY == 0:
                writer.commit()


def require_new(path: Path) -> None:
    """Refuse to make a map where there is a file already."""
    if path.exists() or path.is_symlink():
        raise DatabaseError(
            f"{path} exists; name another file, remove it, or add to it: trigpoint-db add"
        )


@contextmanager
def spare_file(path: Path) -> Iterator[Path]:
    """Name a file beside a map for making it; no such file stays, nor those of killed processes.

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
    _remove(lock_path(path))


def _remove(leftover: Path) -> None:
    with suppress(OSError):
        leftover.unlink()
