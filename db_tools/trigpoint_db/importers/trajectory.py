"""Images and poses that have times of their own: where a camera was between two poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import PosedImage

MAX_GAP_S = 0.2  # between two poses that a camera is placed between


@dataclass(frozen=True, eq=False)
class TimedImage:
    """An image of a data set whose poses are at times of their own."""

    time_ns: int
    name: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where a frame b was in a frame a: `a_from_b` (N,) at rising `times_ns` (N,) int64."""

    times_ns: NDArray[np.int64]
    a_from_b: Rigid3

    @classmethod
    def from_poses(cls, where: str, times_ns: ArrayLike, a_from_b: Sequence[Rigid3]) -> Trajectory:
        """Sort at least one pose by time; `where` they come from is for messages.

        A pose may be there twice, but not two different ones at a time.
        """
        poses = Rigid3.stack(a_from_b)
        times, first = np.unique(np.asarray(times_ns, dtype=np.int64), return_index=True)
        of_time = first[np.searchsorted(times, times_ns)]
        same = np.isclose(poses.R, poses[of_time].R).all(axis=(1, 2))
        same &= np.isclose(poses.t, poses[of_time].t).all(axis=1)
        if not same.all():
            time_ns = np.asarray(times_ns)[np.argmin(same)]
            raise ConfigError(
                f"{where}: there are two different poses at {time_ns} ns; choose one source of them"
            )
        return cls(times, poses[first])

    def at(self, times_ns: NDArray[np.int64], max_gap_s: float) -> tuple[Rigid3, NDArray[np.bool_]]:
        """Return a_from_b (M,) at other times (M,), and whether it is known (M,) there.

        It is where a pose stands, or between two that are at most `max_gap_s` apart: the rotation
        by spherical, the position by linear interpolation. Elsewhere it has no meaning.
        """
        known_ns, last = self.times_ns, len(self.times_ns) - 1
        after = np.minimum(np.searchsorted(known_ns, times_ns), last)
        before = np.where(known_ns[after] == times_ns, after, np.maximum(after - 1, 0))
        inside = (known_ns[before] <= times_ns) & (times_ns <= known_ns[after])
        found = inside & (known_ns[after] - known_ns[before] <= max_gap_s * 1e9)
        if last == 0:
            return self.a_from_b[before], found
        # From the first on: nanoseconds of an epoch have more digits than a float.
        known_s = (known_ns - known_ns[0]) * 1e-9
        wanted_s = (np.clip(times_ns, known_ns[0], known_ns[-1]) - known_ns[0]) * 1e-9
        R = Slerp(known_s, Rotation.from_matrix(self.a_from_b.R))(wanted_s).as_matrix()
        t = [np.interp(wanted_s, known_s, self.a_from_b.t[:, axis]) for axis in range(3)]
        return Rigid3(R, np.stack(t, axis=-1)), found


def place_images(
    where: str,
    images: Sequence[TimedImage],
    world_from_cam: Rigid3,
    found: NDArray[np.bool_],
) -> list[PosedImage]:
    """Give images (M,) their poses (M,) where those are `found` (M,); none at all is an error."""
    if not found.any():
        raise ConfigError(
            f"{where}: none of the {len(images)} images lies between two poses that are near in "
            "time; check that both have the same clock, or allow a longer gap with --max-gap"
        )
    cam_from_world = world_from_cam.inverse()
    return [
        PosedImage(image.name, image.camera, cam_from_world[i])
        for i, image in enumerate(images)
        if found[i]
    ]
