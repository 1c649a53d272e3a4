"""Where the cameras are: a systematic survey of a room, and a drone's flight through it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.synthetic.world import World

Array = NDArray[np.float64]

FLIGHT_CLEARANCE_M = 0.4
_SURVEY_CLEARANCE_M = 0.5
_HEADINGS = 8  # survey images a station
_LAPS, _WAYPOINTS, _DRAWS = 2, 14, 8  # of a flight, and places tried for each waypoint
_LOOK_AHEAD_M = 1.5  # a drone turns before it moves
_FINE = 3000  # steps in which a curve is checked and measured


def look_along(
    center: ArrayLike, yaw_rad: ArrayLike, pitch_rad: ArrayLike, roll_rad: ArrayLike
) -> Rigid3:
    """Return `cam_from_world` of cameras at `center` (..., 3) from their heading.

    Yaw turns the optical axis from the world's x axis towards y, pitch raises it over the
    horizon, roll turns the camera clockwise as seen from behind. The world's z axis points up.
    """
    yaw, pitch, roll = np.broadcast_arrays(yaw_rad, pitch_rad, roll_rad)
    c, s = np.cos(yaw), np.sin(yaw)
    zero = np.zeros_like(c)
    forward = np.stack([np.cos(pitch) * c, np.cos(pitch) * s, np.sin(pitch)], axis=-1)
    level_right = np.stack([s, -c, zero], axis=-1)
    level_down = np.cross(forward, level_right)
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    right, down = c * level_right + s * level_down, c * level_down - s * level_right
    R = np.stack([right, down, forward], axis=-2)
    return Rigid3.from_center(R, np.asarray(center, dtype=np.float64))


def look_at(center: ArrayLike, target: ArrayLike) -> Rigid3:
    """Return `cam_from_world` of upright cameras at `center` (..., 3) facing `target`."""
    direction = np.asarray(target, dtype=np.float64) - np.asarray(center, dtype=np.float64)
    x, y, z = np.moveaxis(direction, -1, 0)
    return look_along(center, np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), 0.0)


def survey_poses(world: World, num: int, seed: int = 0) -> Rigid3:
    """Return `cam_from_world` (num,) of a survey: stations all over the room, headings all round.

    Stations lie on a grid at three heights, chosen one after the other farthest from those
    before; each is photographed in all directions, slightly downwards.
    """
    rng = np.random.default_rng(seed)
    low, high = world.limits
    x, y = (np.arange(a + 0.4, b - 0.4, 0.25) for a, b in zip(low[:2], high[:2], strict=True))
    grid = np.stack(np.meshgrid(x, y, (0.8, 1.3, 1.8)), axis=-1).reshape(-1, 3)
    free = grid[world.clearance(grid) > _SURVEY_CLEARANCE_M]
    num_stations = -(-num // _HEADINGS)
    if len(free) < num_stations:
        raise ConfigError(
            f"found {len(free)} places for {num_stations} survey stations; ask for fewer images"
        )
    stations = _farthest_points(free, num_stations, rng)
    headings = np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
    yaw = headings + rng.uniform(0, 2 * np.pi, (num_stations, 1))
    centers = stations[:, None] + rng.uniform(-0.05, 0.05, (*yaw.shape, 3))
    pitch, roll = rng.uniform(-0.3, 0.05, yaw.shape), rng.uniform(-0.03, 0.03, yaw.shape)
    return look_along(centers.reshape(-1, 3), yaw.ravel(), pitch.ravel(), roll.ravel())[:num]


def flight_poses(world: World, num: int, seed: int = 0) -> Rigid3:
    """Return `cam_from_world` (num,) of a flight at constant speed, evenly spaced in time.

    Two laps of a closed smooth curve round the middle, at least FLIGHT_CLEARANCE_M from every
    surface. The camera looks ahead and sways to the sides; roll and pitch stay small.
    """
    rng = np.random.default_rng(seed)
    path = _free_loop(world, rng)
    fine = np.linspace(0, 1, _FINE)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path(fine), axis=0), axis=1))])
    travelled = np.arange(num) / num * length[-1]
    centers = path(np.interp(travelled, length, fine))
    ahead = path(np.interp((travelled + _LOOK_AHEAD_M) % length[-1], length, fine)) - centers
    phase = 2 * np.pi * (travelled[:, None] / length[-1] * (3, 5, 7) + rng.uniform(0, 1, 3))
    sway, nod, roll = (np.sin(phase) * (0.4, 0.1, 0.07)).T
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0]) + sway
    return look_along(centers, yaw, nod - 0.12, roll)


def _free_loop(world: World, rng: np.random.Generator) -> CubicSpline:
    """Draw closed curves over 0..1 through free places until one keeps the clearance."""
    low, high = world.limits
    turns = np.linspace(0, 2 * np.pi * _LAPS, _WAYPOINTS + 1)
    for _ in range(500):
        radius = rng.uniform(0.3, 0.62, (_WAYPOINTS, _DRAWS, 1))
        angle = turns[:-1, None] + rng.uniform(-0.2, 0.2, (_WAYPOINTS, _DRAWS))
        circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        height = rng.uniform(-0.4, 0.55, (_WAYPOINTS, _DRAWS, 1))
        places = (low + high) / 2 + np.concatenate([circle, height], axis=-1) * (high - low) / 2
        clearance = world.clearance(places.reshape(-1, 3)).reshape(_WAYPOINTS, _DRAWS)
        # The first free draw of each waypoint, not the freest: flights shall differ.
        free = np.argmax(clearance > 1.2 * FLIGHT_CLEARANCE_M, axis=1)
        loop = places[np.arange(_WAYPOINTS), free]
        path = CubicSpline(turns / turns[-1], np.vstack([loop, loop[:1]]), bc_type="periodic")
        # Between the checked points, some mm apart, the curve may come a little nearer.
        if world.clearance(path(np.linspace(0, 1, _FINE))).min() > FLIGHT_CLEARANCE_M + 0.01:
            return path
    raise ConfigError(
        f"found no flight {FLIGHT_CLEARANCE_M} m clear of everything; use a world with more space"
    )


def _farthest_points(points: Array, num: int, rng: np.random.Generator) -> Array:
    """Choose `num` of the points (N, 3), each the farthest from those chosen before."""
    chosen = rng.integers(len(points), size=num)
    distance = np.full(len(points), np.inf)
    for i in range(1, num):
        last = points[chosen[i - 1]]
        distance = np.minimum(distance, np.linalg.norm(points - last, axis=1))
        chosen[i] = np.argmax(distance)
    return points[chosen]
