"""EuRoC MAV: the images of one camera and the body's estimated poses, of Burri et al. 2016.

The layout is ASL's, https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets:
in `mav0`, `cam0/data.csv` with `time [ns],file` lines, `cam0/sensor.yaml` with the intrinsics and
T_BS, which takes the camera's coordinates to the body's, and `state_groundtruth_estimate0/data.csv`
with the body's position and orientation (qw first) in the world at 200 Hz, among columns that are
not needed. Lines end as in Windows. Intrinsics are Kalibr's: the top-left pixel centre at (0, 0).
The truth begins after the first images: those are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import Dataset, pose_from_matrix
from trigpoint_db.importers.trajectory import MAX_GAP_S, TimedImage, Trajectory, place_images
from trigpoint_db.poses import pose_from_numbers, read_entries

_TRUTH = Path("state_groundtruth_estimate0", "data.csv")
_LENSES = {"radial-tangential": "OPENCV", "equidistant": "OPENCV_FISHEYE"}


def detect(root: Path) -> bool:
    """Say whether `root` is a sequence, its mav0, or the folder of a camera there."""
    return (_find_camera_folder(root).parent / _TRUTH).is_file()


def read(root: Path, *, max_gap: float = MAX_GAP_S) -> Dataset:
    """Read the camera whose folder is `root`, or cam0 of a sequence; `max_gap` is in seconds."""
    folder = _find_camera_folder(root)
    camera, body_from_cam = _read_sensor(folder / "sensor.yaml")
    path = folder / "data.csv"
    images = []
    for where, (time, *words) in _read_rows(path):
        if len(words) != 1 or not words[0]:
            raise ConfigError(f"{where}: expected 'time,file'")
        name = f"{folder.name}/data/{words[0]}"
        images.append(TimedImage(_time_ns(where, time), name, camera))
    if not images:
        raise ConfigError(f"{path} names no images")
    times_ns = np.array([image.time_ns for image in images])
    world_from_body, found = _read_truth(folder.parent / _TRUTH).at(times_ns, max_gap)
    mapped = place_images(str(path), images, world_from_body @ body_from_cam, found)
    return Dataset(folder.parent, mapped, num_unposed=len(images) - len(mapped))


def _find_camera_folder(root: Path) -> Path:
    if (root / "sensor.yaml").is_file():
        return root.resolve()  # so that it has a parent
    return (root / "mav0" if (root / "mav0").is_dir() else root) / "cam0"


def _read_sensor(path: Path) -> tuple[Camera, Rigid3]:
    """Read the camera and body_from_cam."""
    try:
        text = path.read_text(encoding="utf-8")
        flags = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
        file = cv2.FileStorage(text, flags)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"cannot read {path}: it is not UTF-8 text") from error
    except (cv2.error, SystemError) as error:
        raise ConfigError(f"cannot read {path}: it is not YAML") from error
    model = file.getNode("camera_model").string()
    lens = file.getNode("distortion_model").string()
    if model != "pinhole" or lens not in _LENSES:
        raise ConfigError(
            f"{path}: a camera of the model {model!r} with the distortion {lens!r} is not "
            f"supported; it has to be a pinhole with {' or '.join(_LENSES)}"
        )
    size = _numbers(path, file.getNode("resolution"), "resolution", 2)
    params = _numbers(path, file.getNode("intrinsics"), "intrinsics", 4)
    params += _numbers(path, file.getNode("distortion_coefficients"), "distortion_coefficients", 4)
    matrix = _numbers(path, file.getNode("T_BS").getNode("data"), "T_BS: data", 16)
    try:
        camera = Camera(_LENSES[lens], int(size[0]), int(size[1]), tuple(params))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return camera, pose_from_matrix(f"{path}: T_BS", matrix)


def _numbers(path: Path, node: cv2.FileNode, key: str, count: int) -> list[float]:
    values = [node.at(i) for i in range(node.size())] if node.isSeq() else []
    if len(values) != count or not all(value.isInt() or value.isReal() for value in values):
        raise ConfigError(f"{path}: {key} has to be a list of {count} numbers")
    return [value.real() for value in values]


def _read_truth(path: Path) -> Trajectory:
    times_ns, poses = [], []
    for where, (time, *words) in _read_rows(path):
        try:
            px, py, pz, qw, qx, qy, qz = (float(word) for word in words[:7])
        except ValueError:
            raise ConfigError(f"{where}: expected 'time,px,py,pz,qw,qx,qy,qz,...'") from None
        times_ns.append(_time_ns(where, time))
        poses.append(pose_from_numbers(where, (qw, qx, qy, qz, px, py, pz)))
    if not poses:
        raise ConfigError(f"{path} holds no poses")
    return Trajectory.from_poses(str(path), times_ns, poses)


def _read_rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    for where, line in read_entries(path):
        yield where, [word.strip() for word in line.split(",")]


def _time_ns(where: str, text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**63:
        raise ConfigError(f"{where}: {text[:80]!r} is no time in nanoseconds")
    return int(text)
