"""Map files that appear under their names once they are whole."""

from __future__ import annotations

import contextlib
import glob
import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from trigpoint.database.codec import Profile
from trigpoint.database.index import MIN_ROWS, build_index
from trigpoint.database.reader import MapReader
from trigpoint.database.snapshot import put_in_place
from trigpoint.database.writer import MapWriter
from trigpoint.errors import DatabaseError
from trigpoint.frame import ModelIdentity

COMMIT_EVERY = 100  # images of a new map; until then they are in memory


@contextmanager
def new_map(
    path: Path, model: ModelIdentity, profile: Profile = Profile.STANDARD
) -> Iterator[MapWriter]:
    """Write a map that is there when it is complete; one that is there already is an error."""
    _refuse_existing(path)
    with _partial_file(path) as partial:
        try:
            with MapWriter.create(partial, model, profile) as writer:
                yield writer
        except DatabaseError as error:
            raise DatabaseError(str(error).replace(str(partial), str(path))) from error
        _refuse_existing(path)
        partial.rename(path)


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
    with closing(MapWriter.open(path, model)) as writer, _partial_file(path) as partial:
        if had_index or profile not in (None, profile_before):
            _rewrite(path, partial, profile or profile_before, track)
        else:
            writer.copy_to(partial)
        if is_indexed:
            build_index(partial, track)
        put_in_place(partial, path)


def _rewrite(
    path: Path, new: Path, profile: Profile, track: Callable[[range], Iterable[int]]
) -> None:
    """Write the images of a map to a new file of the same owner and mode, and no index."""
    with (
        MapReader.open(path) as reader,
        MapWriter.create(new, reader.model, profile, reader.generation) as writer,
    ):
        status = path.stat()
        os.chown(new, status.st_uid, status.st_gid)
        new.chmod(stat.S_IMODE(status.st_mode))
        writer.set_pose_noise(reader.pose_noise)
        for i in track(range(len(reader))):
            record = reader.record(i)
            writer.add_record(record, record.name)
            if len(writer) % COMMIT_EVERY == 0:
                writer.commit()


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
        _remove(partial)
        _remove(partial.with_name(partial.name + "-lock"))


def _remove(leftover: Path) -> None:
    with contextlib.suppress(OSError):
        leftover.unlink()
