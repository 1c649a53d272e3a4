"""hloc's text files: lists of images, queries with their cameras, and poses."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.frame import Prior
from trigpoint.output import write_atomically
from trigpoint.poses import format_pose
from trigpoint.rigid import Rigid3

# Names may hold spaces: the camera begins at the first word followed by the two sizes.
_QUERY = re.compile(r"(?P<name>\S.*?)\s+(?P<camera>[A-Z][A-Z_]*\s+\d+\s+\d+\s.*)")


_BOM = "\ufeff"  # which says at the begin of a file that it is UTF-8


@dataclass(frozen=True)
class Query:
    """An image to localize and the camera that took it."""

    name: str
    camera: Camera


def read_names(path: Path) -> list[str]:
    """Read an image list: a name on each line, in the file's order; a query's camera is dropped."""
    names: dict[str, None] = {}
    for where, line in read_entries(path):
        match = _QUERY.fullmatch(line)
        name = match["name"] if match and _are_numbers(match["camera"].split()[1:]) else line
        check_new(where, name, names)
        names[name] = None
    return list(names)


def _are_numbers(words: Iterable[str]) -> bool:
    try:
        return all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def read_queries(path: Path) -> list[Query]:
    """Read `name MODEL width height params...` lines, in the file's order."""
    queries: dict[str, Query] = {}
    for where, line in read_entries(path):
        match = _QUERY.fullmatch(line)
        if match is None:
            raise ConfigError(
                f"{where}: expected 'name MODEL width height params...', not {line[:80]!r}"
            )
        try:
            query = Query(match["name"], Camera.from_text(match["camera"]))
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error
        check_new(where, query.name, queries)
        queries[query.name] = query
    return list(queries.values())


def read_poses(path: Path) -> dict[str, Rigid3]:
    """Read `name qw qx qy qz tx ty tz` lines: cam_from_world by name, in the file's order."""
    rows = read_rows(read_entries(path), "name qw qx qy qz tx ty tz")
    return {name: pose_from_numbers(where, values) for where, name, values in rows}


def write_queries(path: Path, queries: Iterable[Query]) -> None:
    """Write what `read_queries` reads, in this order."""
    queries = list(queries)
    _check_names(path, (query.name for query in queries))
    write_atomically(path, "".join(f"{q.name} {q.camera.to_text()}\n" for q in queries))


def read_priors(path: Path) -> dict[str, Prior]:
    """Read `name x y z radius` lines: where the camera of each query was about."""
    priors: dict[str, Prior] = {}
    for where, name, (x, y, z, radius) in read_rows(read_entries(path), "name x y z radius"):
        try:
            priors[name] = Prior((x, y, z), radius)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error
    return priors


def write_poses(path: Path, poses: Mapping[str, Rigid3]) -> None:
    """Write what `read_poses` reads, sorted by name: equal poses give equal bytes."""
    _check_names(path, poses)
    write_atomically(path, "".join(format_pose(name, poses[name]) for name in sort_names(poses)))


def format_numbers(*values: float) -> str:
    """Format numbers with every digit, separated by spaces."""
    return " ".join(repr(float(value)) for value in values)


def _check_names(path: Path, names: Iterable[str]) -> None:
    for name in names:
        if not is_writable(name) or name.startswith("#"):
            raise ConfigError(f"the name {name!r} cannot stand in {path}; rename the image")


def is_writable(name: str) -> bool:
    """Say whether a name survives being written to a line of text and read again."""
    try:
        name.encode()
    except UnicodeEncodeError:  # of a file whose name is not UTF-8
        return False
    is_text = all(unicodedata.category(char) != "Cc" for char in name)
    return bool(name) and name == name.strip() and is_text and name[0] != _BOM


def pose_from_center(where: str, wxyz: Sequence[float], center: Sequence[float]) -> Rigid3:
    """Make cam_from_world of its quaternion and of the camera's position in the world."""
    R = pose_from_numbers(where, [*wxyz, *center]).R
    return Rigid3.from_center(R, np.array(center, dtype=np.float64))


def pose_from_numbers(where: str, values: Sequence[float]) -> Rigid3:
    """Make cam_from_world of qw qx qy qz tx ty tz; `where` says where they stand."""
    if not all(map(math.isfinite, values)):
        raise ConfigError(f"{where}: the pose {format_numbers(*values)} is not finite")
    if not 0.1 < math.hypot(*values[:4]) < 10:  # far from 1, it is not a quaternion
        raise ConfigError(
            f"{where}: the quaternion {format_numbers(*values[:4])} is not one of a rotation; "
            "it comes first, as qw qx qy qz, and has length 1"
        )
    return Rigid3.from_quaternion(values[:4], values[4:])


def sort_names(names: Iterable[str]) -> list[str]:
    """Sort names, by value where all are integers, such as times in nanoseconds."""
    names = list(names)
    if all(name.removeprefix("-").isdecimal() for name in names):
        return sorted(names, key=lambda name: (int(name), name))
    return sorted(names)


def read_lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield every line, stripped, and before it `path:number` for messages."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                yield f"{path}:{number}", line.strip()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"cannot read {path}: it is not UTF-8 text") from error


def read_entries(path: Path) -> Iterator[tuple[str, str]]:
    """Yield as `read_lines` does, without comments and empty lines."""
    return ((where, line) for where, line in read_lines(path) if line and line[0] != "#")


def read_rows(
    entries: Iterable[tuple[str, str]], layout: str
) -> Iterator[tuple[str, str, list[float]]]:
    """Yield where a line stands, its name and its numbers; `layout` names them, as 'name x y z'.

    Lines of another layout and names that come twice are errors.
    """
    num_values, names = len(layout.split()) - 1, set[str]()
    for where, line in entries:
        name, *words = line.rsplit(maxsplit=num_values)  # from the right: names may hold spaces
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) != num_values:
            raise ConfigError(f"{where}: expected {layout!r}, not {line[:80]!r}")
        check_new(where, name, names)
        names.add(name)
        yield where, name, values


def check_new(where: str, name: str, seen: Container[str]) -> None:
    """Refuse a name that the file has had before."""
    if name in seen:
        raise ConfigError(f"{where}: {name} is in this file twice; remove one")
