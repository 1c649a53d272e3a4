"""The demo: a small rendered world, surveyed and flown through, ready for the daemon."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.poses import format_pose
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import write_model
from trigpoint_db.recording import START_TIME_NS, RecordedImage, write_recording
from trigpoint_db.synthetic import flight_poses, make_room, render, survey_poses

# A lens with some distortion, as real ones have.
CAMERA = Camera("OPENCV", 640, 480, (460.0, 460.0, 319.5, 239.5, -0.08, 0.02, 0.001, -0.0005))
# The camera looks ahead from the nose of the drone: body x ahead, y left, z up; camera x right,
# y down, z ahead.
_POSITION_M = [0.12, 0.0, 0.03]
_ROTATION_WXYZ = [0.5, -0.5, 0.5, -0.5]
BODY_FROM_CAMERA = Rigid3.from_quaternion(_ROTATION_WXYZ, _POSITION_M)

_CONFIG = f"""\
# Settings of `trigpointd run`; docs/configuration.md describes every key.
map = "map.tpmap"
base_key = "trigpoint/demo"

[source]
type = "mcap"
path = "flight.mcap"

[camera] # where it sits on the body
position_m = {_POSITION_M}
rotation_wxyz = {_ROTATION_WXYZ}

[zenoh]
connect = ["tcp/127.0.0.1:17447"]
multicast_scouting = false
wait_for_subscriber_s = 10.0

[log]
path = "log.mcap"
overwrite = true
"""


def prepare_folder(folder: Path) -> None:
    """Make the folder, or clear the files of a demo before; a folder of anything else is kept."""
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "trigpointd.toml").is_file():
        raise ConfigError(f"{folder} is not empty and holds no demo; name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("map.tpmap", "flight.mcap"):
        (folder / name).unlink(missing_ok=True)
    (folder / "trigpointd.toml").write_text(_CONFIG)


def render_images(
    room_seed: int, cams_from_world: Rigid3, folder: Path, *, noise_seed: int, num_jobs: int = 2
) -> Iterator[PosedImage]:
    """Render one JPEG a pose into a folder, yielding each as it is done, in order."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = [cams_from_world[i] for i in range(len(cams_from_world))]
    work = partial(_render_one, room_seed, folder, noise_seed)
    # OpenCV's threads do not survive a fork.
    with ProcessPoolExecutor(num_jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(work, range(len(poses)), poses)


def _render_one(
    room_seed: int, folder: Path, noise_seed: int, index: int, cam_from_world: Rigid3
) -> PosedImage:
    cv2.setNumThreads(1)
    name = f"{index:06d}.jpg"
    image = render(make_room(room_seed), CAMERA, cam_from_world, seed=noise_seed + index)
    if not cv2.imwrite(str(folder / name), image, [cv2.IMWRITE_JPEG_QUALITY, 92]):
        raise ConfigError(f"cannot write images to {folder}")
    return PosedImage(name, CAMERA, cam_from_world)


def make_demo(
    folder: Path,
    *,
    num_survey: int = 140,
    num_flight: int = 120,
    rate_hz: float = 10.0,
    seed: int = 0,
    progress: Callable[[Iterator[PosedImage], str, int], Iterator[PosedImage]],
) -> list[PosedImage]:
    """Render the survey and the flight; write the COLMAP model, the recording, truth, settings.

    Returns the survey, from which the map is built. `truth.txt` holds the body's poses, as
    `trigpointd watch --poses` writes them.
    """
    world = make_room(seed)
    survey = list(
        progress(
            render_images(
                seed, survey_poses(world, num_survey, seed), folder / "survey", noise_seed=1000
            ),
            "survey",
            num_survey,
        )
    )
    write_model(folder / "sparse", survey)
    flight = list(
        progress(
            render_images(
                seed, flight_poses(world, num_flight, seed), folder / "flight", noise_seed=5000
            ),
            "flight",
            num_flight,
        )
    )
    write_recording(
        folder / "flight.mcap",
        [RecordedImage(folder / "flight" / i.name, i.camera, i.cam_from_world) for i in flight],
        rate_hz=rate_hz,
    )
    times_ns = START_TIME_NS + np.round(np.arange(num_flight) * 1e9 / rate_hz).astype(np.int64)
    lines = [
        format_pose(str(time_ns), BODY_FROM_CAMERA @ image.cam_from_world)
        for time_ns, image in zip(times_ns, flight, strict=True)
    ]
    (folder / "truth.txt").write_text("".join(lines))
    queries = [f"{image.name} {image.camera.to_text()}\n" for image in flight]
    (folder / "queries.txt").write_text("".join(queries))
    return survey
