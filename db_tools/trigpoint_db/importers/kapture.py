"""kapture: the cameras, records and trajectories of its `sensors` folder.

https://github.com/naver/kapture/blob/main/kapture_format.adoc: comma separated values, of which
spaces do not count; cameras are COLMAP's, poses qw qx qy qz tx ty tz from the world to the device,
which may be a rig; rigs.txt has the poses from rig to sensor, where a sensor may be a rig again.
Images are in sensors/records_data. Data sets made of two, `mapping` and `query`, are read as such;
in one alone, the images without a pose are queries. A pose may lack its rotation or its position:
that is none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset, PosedImage
from trigpoint_db.poses import Query, pose_from_numbers, read_entries

_DATA = Path("sensors", "records_data")
_UNKNOWN = "UNKNOWN_CAMERA"


def detect(root: Path) -> bool:
    """Say whether `root` is a kapture, or a folder with one in `mapping`."""
    return any((root / part / "sensors" / "sensors.txt").is_file() for part in ("", "mapping"))


def read(root: Path) -> Dataset:
    """Read the kapture `root`, or those in its `mapping` and `query`."""
    if (root / "sensors").is_dir():
        mapped, unposed, unknown = _read_kapture(root, "")
        return Dataset(root / _DATA, mapped, unposed, num_unposed=unknown)
    mapped, unposed, unknown = _read_kapture(root / "mapping", f"mapping/{_DATA}/")
    num_unposed = len(unposed) + unknown
    if not (root / "query").is_dir():
        return Dataset(root, mapped, num_unposed=num_unposed)
    posed, queries, unknown = _read_kapture(root / "query", f"query/{_DATA}/")
    queries += [Query(image.name, image.camera) for image in posed]
    queries.sort(key=lambda query: query.name)
    truth = {image.name: image.cam_from_world for image in posed}
    return Dataset(root, mapped, queries, truth, num_unposed + unknown)


@dataclass(frozen=True, eq=False)
class _Rigs:
    """Where devices stood, by time and device, and on which rigs they sit."""

    device_from_world: dict[tuple[int, str], Rigid3]
    sensor_from_rig: dict[str, list[tuple[str, Rigid3]]]  # by sensor: rigs and poses on them

    def find(self, time: int, device: str, seen: tuple[str, ...] = ()) -> Rigid3 | None:
        """Return device_from_world, from the device's own pose or that of a rig it sits on."""
        if (own := self.device_from_world.get((time, device))) is not None:
            return own
        for rig, device_from_rig in self.sensor_from_rig.get(device, []):
            if rig not in seen and (found := self.find(time, rig, (*seen, device))) is not None:
                return device_from_rig @ found
        return None


def _read_kapture(folder: Path, prefix: str) -> tuple[list[PosedImage], list[Query], int]:
    """Read the images with a pose, those without, and how many have no camera either."""
    cameras = _read_cameras(folder / "sensors" / "sensors.txt")
    rigs = _Rigs(
        _read_trajectories(folder / "sensors" / "trajectories.txt"),
        _read_rigs(folder / "sensors" / "rigs.txt"),
    )
    posed: dict[str, PosedImage] = {}
    unposed: dict[str, Query] = {}
    num_unknown = 0
    path = folder / "sensors" / "records_camera.txt"
    for where, (time, device, name) in _read_rows(path, "timestamp, device_id, image_path"):
        name = prefix + name
        if device not in cameras:
            raise ConfigError(f"{where}: there is no camera {device} in sensors.txt")
        if name in posed or name in unposed:
            raise ConfigError(f"{where}: {name} is in this file twice; remove one")
        pose, camera = rigs.find(_timestamp(where, time), device), cameras[device]
        if camera is None and pose is not None:
            raise ConfigError(
                f"{where}: the camera {device} is an {_UNKNOWN}; calibrate it, or remove its images"
            )
        if camera is None:
            num_unknown += 1
        elif pose is None:
            unposed[name] = Query(name, camera)
        else:
            posed[name] = PosedImage(name, camera, pose)
    if not posed and not unposed:
        raise ConfigError(f"{path} has no images of a known camera")
    return [posed[n] for n in sorted(posed)], [unposed[n] for n in sorted(unposed)], num_unknown


def _read_cameras(path: Path) -> dict[str, Camera | None]:
    """Read the cameras by device, None where the intrinsics are not known."""
    cameras: dict[str, Camera | None] = {}
    for where, (device, _, kind, *params) in _read_rows(
        path, "sensor_device_id, name, sensor_type", more=True
    ):
        if device in cameras:
            raise ConfigError(f"{where}: the sensor {device} is in this file twice")
        if kind != "camera":
            continue
        try:
            known = params[:1] != [_UNKNOWN]
            cameras[device] = Camera.from_text(" ".join(params)) if known else None
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from error
    return cameras


def _read_trajectories(path: Path) -> dict[tuple[int, str], Rigid3]:
    poses: dict[tuple[int, str], Rigid3] = {}
    if not path.is_file():
        return poses
    header = "timestamp, device_id, qw, qx, qy, qz, tx, ty, tz"
    for where, (time, device, *numbers) in _read_rows(path, header):
        key = (_timestamp(where, time), device)
        if key in poses:
            raise ConfigError(f"{where}: {device} has two poses at {time}; remove one")
        if all(numbers):
            poses[key] = _pose(where, numbers)
    return poses


def _read_rigs(path: Path) -> dict[str, list[tuple[str, Rigid3]]]:
    rigs: dict[str, list[tuple[str, Rigid3]]] = {}
    if path.is_file():
        header = "rig_device_id, sensor_device_id, qw, qx, qy, qz, tx, ty, tz"
        for where, (rig, sensor, *numbers) in _read_rows(path, header):
            if all(numbers):
                rigs.setdefault(sensor, []).append((rig, _pose(where, numbers)))
    return rigs


def _pose(where: str, numbers: list[str]) -> Rigid3:
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        raise ConfigError(
            f"{where}: expected qw, qx, qy, qz, tx, ty, tz, not {', '.join(numbers)}"
        ) from None
    return pose_from_numbers(where, values)


def _read_rows(path: Path, header: str, *, more: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Yield the fields of each line, as many as the header has, or more."""
    count = header.count(",") + 1
    for where, line in read_entries(path):
        fields = [field.strip() for field in line.split(",")]
        if len(fields) < count or (len(fields) > count and not more):
            raise ConfigError(f"{where}: expected '{header}', not {line[:80]!r}")
        yield where, fields


def _timestamp(where: str, text: str) -> int:
    """Read a timestamp, of which leading zeros do not count."""
    try:
        return int(text)
    except ValueError:
        raise ConfigError(f"{where}: the timestamp {text!r} is not an integer") from None
