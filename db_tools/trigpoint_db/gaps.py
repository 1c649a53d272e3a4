"""Where to go and photograph, so that a map loses its thin and blind places."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from trigpoint.database.reader import MapReader
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.coverage import Coverage, Grade, view_distance
from trigpoint_db.sampling import spread_indices

Array = NDArray[np.float64]

MAX_COMPARED = 600  # images of the map among which gaps are looked for
MAX_GAP = 4.0  # view distance, more than that of turning round: the ends are different places
MIN_MEETING = 0.1  # sine of the angle between optical axes that meet


@dataclass(frozen=True, eq=False)
class Place:
    """A pose where no image of the map was taken.

    Parameters
    ----------
    cam_from_world : Rigid3
    grade : Grade
        What to expect of frames there.
    reason : str
        For people.
    """

    cam_from_world: Rigid3
    grade: Grade
    reason: str


def find_gaps(reader: MapReader, coverage: Coverage) -> list[Place]:
    """Return places between images, the widest gaps first.

    A gap is between two images with none in between (neighbours in the Gabriel graph) that are
    farther apart than twice `Coverage.apart`: in the middle a frame would be farther from both
    than that. The places are on the way from one to the other, and what to expect there follows
    from how far the images at the ends reach. Of a large map `MAX_COMPARED` images are compared;
    places nearer than `Coverage.apart` to any image at all are left out.
    """
    chosen = spread_indices(len(reader), MAX_COMPARED)
    views, names = coverage.images_from_world[np.array(chosen)], reader.names()
    distances = np.stack(
        [view_distance(views, views[i], coverage.median_depth) for i in range(len(views))]
    )
    wide = [
        pair for pair in neighbor_pairs(distances) if 2 * coverage.apart < distances[pair] < MAX_GAP
    ]
    places: list[Place] = []
    for i, j in sorted(wide, key=lambda pair: -distances[pair]):
        far = float(np.linalg.norm(views[i].center - views[j].center))
        angle_deg = float(np.rad2deg(rotation_angle(views[i].R @ views[j].R.T)))
        between = f"between {names[chosen[i]]} and {names[chosen[j]]}"
        reason = f"{between}, which are {far:.3g} and {angle_deg:.0f} degrees apart"
        num_steps = int(np.ceil(distances[i, j] / (2 * coverage.apart)))
        on_the_way = _between(views[i], views[j], num_steps)
        places += [
            Place(pose, coverage.expect(pose), reason)
            for pose in on_the_way
            if coverage.distance_to_images(pose) > coverage.apart
        ]
    return places


def suggest_poses(coverage: Coverage, gaps: Iterable[Place], max_poses: int) -> list[Place]:
    """List poses to go and photograph: gaps that images do not reach across, and weak places.

    A gap is listed where a frame in it would be thin or blind, and so next to images that are
    there. Where an image itself is blind or thin without its surroundings, one pose beside it, on
    the side with more room, shows the same from elsewhere. A pose that is nearer than
    `Coverage.apart` to one listed before is left out.
    """
    wanted = [place for place in gaps if place.grade is not Grade.STRONG]
    for grade in (Grade.BLIND, Grade.THIN):
        for probe in coverage.probes:
            if probe.grade is grade:
                how = f"{probe.outcome} with {probe.num_anchors} anchors that agree"
                pose = _beside(probe.cam_from_world, coverage)
                wanted.append(Place(pose, grade, f"beside {probe.name}, {how}"))
    kept: list[Place] = []
    for place in wanted:
        if len(kept) == max_poses:
            break
        listed = Rigid3.stack(other.cam_from_world for other in kept)
        apart = view_distance(listed, place.cam_from_world, coverage.median_depth)
        if (apart >= coverage.apart).all():
            kept.append(place)
    return kept


def neighbor_pairs(distances: Array) -> list[tuple[int, int]]:
    """Return the Gabriel graph of points with these distances (N, N).

    Gabriel and Sokal, "A new statistical approach to geographic variation analysis", 1969: pairs
    i < j with no third point k in the ball between them, where d_ik^2 + d_jk^2 < d_ij^2.
    """
    squares, pairs = distances**2, []
    for i, row in enumerate(squares):
        nearest = (row + squares).min(axis=1)  # of each j: the third point that is most between
        pairs += [(i, int(j)) for j in np.flatnonzero(nearest >= row * (1 - 1e-9)) if j > i]
    return pairs


def _between(a: Rigid3, b: Rigid3, num_steps: int) -> list[Rigid3]:
    """Return poses on the way from one to another.

    Cameras that look at the same thing go around it, so that it stays in sight: the point where
    their optical axes meet moves straight in the camera's frame. All others go straight.
    """
    shares = np.arange(1, num_steps) / num_steps
    R = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([a.R, b.R])))(shares).as_matrix()
    pivot = _meeting_point(a, b)
    if pivot is None:
        centers = a.center + shares[:, None] * (b.center - a.center)
        return [Rigid3.from_center(R[k], centers[k]) for k in range(len(shares))]
    start, end = a.apply(pivot), b.apply(pivot)
    seen = start + shares[:, None] * (end - start)
    return [Rigid3(R[k], seen[k] - R[k] @ pivot) for k in range(len(shares))]


def _meeting_point(a: Rigid3, b: Rigid3) -> Array | None:
    """Return the point nearest to two optical axes; None where it is behind one of the cameras."""
    both = Rigid3.stack([a, b])
    ahead = both.R[:, 2]
    if np.linalg.norm(np.cross(*ahead)) < MIN_MEETING:
        return None
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    point: Array = np.linalg.solve(across.sum(axis=0), np.einsum("kij,kj->i", across, both.center))
    return point if (both.apply(point)[:, 2] >= 0).all() else None


def _beside(pose: Rigid3, coverage: Coverage) -> Rigid3:
    """Step sideways by as far as a frame may be from an image, to where fewer images are."""
    step = coverage.apart * coverage.median_depth
    sides = [Rigid3.from_center(pose.R, pose.center + sign * step * pose.R[0]) for sign in (1, -1)]
    return max(sides, key=coverage.distance_to_images)
