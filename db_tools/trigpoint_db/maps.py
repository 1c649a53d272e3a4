"""Maps edited as a whole: images removed, maps merged, split and compared."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import COMMIT_EVERY, new_map, rewritten_map
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.frame import Anchor, Session
from trigpoint.rigid import rotation_angle

Track = Callable[[Sequence[int]], Iterable[int]]


def count_sessions(reader: MapReader) -> dict[Session | None, int]:
    """Count the images of each session that has any; those of none come last."""
    counts = Counter(reader.sessions_by_index())
    return {session: counts[session] for session in (*reader.sessions, None) if counts[session]}


def find_session(path: Path, name: str) -> list[str]:
    """Return the names of the images of a session."""
    with MapReader.open(path) as reader:
        if name not in {session.name for session in reader.sessions}:
            known = ", ".join(sorted({s.name for s in reader.sessions}))
            raise ConfigError(f"{path} has no session {name!r}; it has {known or 'none'}")
        sessions = reader.sessions_by_index()
        return [
            image
            for image, session in zip(reader.names(), sessions, strict=True)
            if session is not None and session.name == name
        ]


def remove_images(path: Path, names: Iterable[str]) -> None:
    """Remove images from a map, all or none of them."""
    with MapReader.open(path) as reader:
        model = reader.model
    with MapWriter.open(path, model) as writer:
        for name in names:
            writer.remove(name)


def merge_maps(a: Path, b: Path, out: Path, *, prefix: str = "", track: Track = iter) -> int:
    """Write the images of two maps of one model to a new one; returns how many.

    `prefix` is put before the names of the second. The new map has the first one's profile. How
    well the poses of both agree is not known: see `calibrate_map`.
    """
    with MapReader.open(a) as first, MapReader.open(b, first.model) as second:
        common = set(first.names()) & {prefix + name for name in second.names()}
        if common:
            raise ConfigError(
                f"{len(common)} names are in both maps, such as {min(common)!r}; put something "
                "before those of the second with --prefix"
            )
        with new_map(out, first.model, first.profile) as writer:
            _copy(first, writer, track(range(len(first))))
            _copy(second, writer, track(range(len(second))), prefix)
            return len(writer)


def split_map(path: Path, box: Sequence[float], out: Path, *, track: Track = iter) -> int:
    """Write the images whose cameras are in a box to a new map; returns how many.

    `box` is xmin, ymin, zmin, xmax, ymax, zmax; its faces belong to it.
    """
    low, high = np.array(box).reshape(2, 3)
    if not (low <= high).all():  # nan too
        raise ConfigError(f"the box {low} to {high} is empty: write xmin,ymin,zmin,xmax,ymax,zmax")
    with MapReader.open(path) as reader:
        if len(reader) == 0:
            raise ConfigError(f"{path} holds no images to split")
        centers = reader.poses().center
        inside = ((low <= centers) & (centers <= high)).all(axis=1)
        if not inside.any():
            extent = f"from {centers.min(axis=0)} to {centers.max(axis=0)}"
            raise ConfigError(f"no camera of {path} is in the box; they are {extent}")
        with new_map(out, reader.model, reader.profile) as writer:
            _copy(reader, writer, track(np.flatnonzero(inside).tolist()))
            writer.set_pose_noise(reader.pose_noise)
            return len(writer)


def copy_without(path: Path, names: Iterable[str], out: Path) -> int:
    """Write the images of a map, but for those named, to a new one; returns how many."""
    with (
        MapReader.open(path) as reader,
        new_map(out, reader.model, reader.profile) as writer,
    ):
        return _copy_without(reader, writer, names)


def leave_out(path: Path, names: Iterable[str]) -> int:
    """Rewrite a map without images, in its order; returns how many are left.

    `remove_images` gives the place of one to the last: that is done at once, but neighbours in the
    map are no more those in the survey.
    """
    with rewritten_map(path) as (reader, writer):
        return _copy_without(reader, writer, names)


def _copy_without(reader: MapReader, writer: MapWriter, names: Iterable[str]) -> int:
    unwanted = set(names)
    _copy(reader, writer, [i for i, name in enumerate(reader.names()) if name not in unwanted])
    writer.set_pose_noise(reader.pose_noise)
    return len(writer)


def _copy(reader: MapReader, writer: MapWriter, indices: Iterable[int], prefix: str = "") -> None:
    for index in indices:
        record = reader.record(index)
        writer.add_record(record, prefix + record.name)
        if len(writer) % COMMIT_EVERY == 0:
            writer.commit()


@dataclass(frozen=True)
class Change:
    """An image that is in two maps, but not the same."""

    name: str
    what: tuple[str, ...]  # of pose, camera, features, session
    distance: float  # between its camera centers, in the maps' unit
    angle_deg: float  # between its rotations
    sessions: tuple[str, str]  # empty for none


@dataclass(frozen=True)
class Difference:
    """What a second map has that the first has not, and so on; by name."""

    added: list[str]
    removed: list[str]
    changed: list[Change]
    num_same: int


def compare_maps(a: Path, b: Path) -> Difference:
    """Compare two maps image by image."""
    with MapReader.open(a) as first, MapReader.open(b) as second:
        before, after = _Images(first), _Images(second)
        common = sorted(before.index_of.keys() & after.index_of.keys())
        changes = [_compare(before.get(name), after.get(name)) for name in common]
    changed = [change for change in changes if change.what]
    return Difference(
        added=sorted(after.index_of.keys() - before.index_of.keys()),
        removed=sorted(before.index_of.keys() - after.index_of.keys()),
        changed=changed,
        num_same=len(common) - len(changed),
    )


class _Images:
    """The images of a map by name."""

    def __init__(self, reader: MapReader) -> None:
        self._reader = reader
        self._sessions = reader.sessions_by_index()
        self.index_of = {name: index for index, name in enumerate(reader.names())}

    def get(self, name: str) -> tuple[Anchor, Session | None]:
        index = self.index_of[name]
        return self._reader.anchor(index), self._sessions[index]


def _compare(before: tuple[Anchor, Session | None], after: tuple[Anchor, Session | None]) -> Change:
    (a, session_a), (b, session_b) = before, after
    pose_a, pose_b = a.cam_from_world, b.cam_from_world
    differs = {
        "pose": not (np.array_equal(pose_a.R, pose_b.R) and np.array_equal(pose_a.t, pose_b.t)),
        "camera": a.camera != b.camera,
        "features": not (
            np.array_equal(a.keypoints, b.keypoints)
            and np.array_equal(a.descriptors, b.descriptors)
        ),
        "session": session_a != session_b,
    }
    return Change(
        a.name,
        tuple(what for what, is_different in differs.items() if is_different),
        float(np.linalg.norm(pose_a.center - pose_b.center)),
        float(np.rad2deg(rotation_angle(pose_a.R @ pose_b.R.T))),
        ("" if session_a is None else str(session_a), "" if session_b is None else str(session_b)),
    )
