"""Which images of a map are better left out, and why.

Images that are blurred, that are there twice, or that share nothing with another cost space and
time and help no frame; a map may also be thinned to a density. Greedily: the sharpest image is
kept, then the next sharpest that none kept so far makes needless, and so on.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.build import read_frame
from trigpoint_db.overlap import measure_overlap

Array = NDArray[np.float64]

BLUR_WINDOW = 9  # px: the mean filter of Crete et al.
NUM_BESIDE = 7  # images on either side in the sequence that tell how sharp one should be
MAX_EXCESS_BLUR = 0.15  # over their median
MIN_SHARED = 40  # keypoints shared with another image
SAME_DISTANCE = 0.01  # of the median depth
SAME_ANGLE_DEG = 1.0
SAME_COSINE = 0.9  # of the global descriptors


class Flaw(StrEnum):
    """Why an image is better left out."""

    NO_OVERLAP = "no_overlap"
    BLURRED = "blurred"
    DUPLICATE = "duplicate"
    DENSE = "dense"


@dataclass(frozen=True)
class Finding:
    """An image that is better left out."""

    name: str
    flaw: Flaw
    detail: str


@dataclass(frozen=True)
class Density:
    """How near to each other keyframes may be: nearer than both, one of two is left out.

    Parameters
    ----------
    distance : float
        Of the camera centers, in the map's unit, or a share of the median depth.
    is_share : bool
        Which of them.
    angle_deg : float
        Between the rotations.
    """

    distance: float
    is_share: bool
    angle_deg: float

    @classmethod
    def from_text(cls, text: str, angle_deg: float) -> Density:
        """Read '0.5', in the map's unit, or '10%', of the median depth of what the images show."""
        try:
            distance = float(text.removesuffix("%"))
        except ValueError:
            distance = -1.0
        if not 0 < distance < np.inf:
            raise ConfigError(
                f"a density is a distance such as 0.5, or 10% of the median depth, not {text!r}"
            )
        is_share = text.endswith("%")
        return cls(distance / 100 if is_share else distance, is_share, angle_deg)

    def resolve(self, median_depth: float) -> float:
        """Return the distance in the map's unit; the depth may be nan."""
        if not self.is_share:
            return self.distance
        if not np.isfinite(median_depth):
            raise ConfigError(
                "the depth of the images is not known: give --density in the map's unit"
            )
        return self.distance * median_depth


@dataclass(frozen=True)
class Selection:
    """What is wrong with which images; all others are kept."""

    num_images: int  # that were looked at
    median_depth: float  # of what they show, in the map's unit; nan where that is not known
    findings: tuple[Finding, ...]  # in the map's order

    @property
    def names(self) -> list[str]:
        """The images that are better left out."""
        return [finding.name for finding in self.findings]

    @property
    def counts(self) -> dict[str, int]:
        """How many images have each flaw."""
        found = Counter(finding.flaw for finding in self.findings)
        return {flaw.value: found[flaw] for flaw in Flaw}

    def to_json(self) -> dict[str, Any]:
        """Return everything in JSON's types."""
        depth = self.median_depth
        return {
            "num_images": self.num_images,
            "median_depth": depth if np.isfinite(depth) else None,
            "counts": self.counts,
            "images": [asdict(finding) for finding in self.findings],
        }

    def __str__(self) -> str:
        found = [
            f"{count} {flaw.replace('_', ' ')}" for flaw, count in self.counts.items() if count
        ]
        return ", ".join(found) or "none blurred, duplicate or without overlap"


def select(
    reader: MapReader,
    folder: Path,
    long_side_px: int,
    *,
    first: int = 0,
    density: Density | None = None,
    track: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> Selection:
    """Find the images of a map that are better left out.

    Parameters
    ----------
    reader : MapReader
        The map, with all images, in the order in which they were taken.
    folder : Path
        Where the images are, as for `read_frame`.
    long_side_px : int
        Of an image as the network sees it: what is lost beyond that is no blur.
    first : int
        Those from this index on are looked at; the ones before stay as they are.
    density : Density, optional
        Keep keyframes only.
    track : callable, optional
        Shows progress.
    """
    names, poses, new = reader.names(), reader.poses(), range(first, len(reader))
    if not new:
        return Selection(0, math.nan, ())
    blur, num_shared, depth = _measure(reader, folder, long_side_px, track(new), first)
    flaws: dict[int, tuple[Flaw, str]] = {}
    for i, excess in zip(new, blur[first:] - running_median(blur[first:]), strict=True):
        if num_shared[i] < MIN_SHARED:
            detail = f"shares {num_shared[i]} keypoints with any other image"
            flaws[i] = (Flaw.NO_OVERLAP, detail)
        elif excess > MAX_EXCESS_BLUR:
            detail = f"blur {blur[i]:.2f}, {excess:.2f} more than its neighbours"
            flaws[i] = (Flaw.BLURRED, detail)

    def leave_out_near(flaw: Flaw, why: str, *limits: Any) -> None:
        sharpest = sorted(new, key=lambda i: blur[i])
        order = [i for i in sharpest if i not in flaws]
        near = find_needless(poses, order, *limits, first=first)
        flaws.update({i: (flaw, f"{why} {names[j]}") for i, j in near.items()})

    def are_alike(i: int, j: int) -> bool:
        a, b = reader.features(i).global_descriptor, reader.features(j).global_descriptor
        return float(a @ b) > SAME_COSINE

    leave_out_near(Flaw.DUPLICATE, "the same as", SAME_DISTANCE * depth, SAME_ANGLE_DEG, are_alike)
    if density is not None:
        leave_out_near(Flaw.DENSE, "near", density.resolve(depth), density.angle_deg)
    findings = tuple(Finding(names[i], *flaws[i]) for i in sorted(flaws))
    return Selection(len(new), depth, findings)


def _measure(
    reader: MapReader, folder: Path, long_side_px: int, indices: Iterable[int], first: int
) -> tuple[Array, NDArray[np.intp], float]:
    """Return blur (N,), shared keypoints (N,) and the median depth; of the first ones, nothing."""
    blur, num_shared = np.zeros(len(reader)), np.zeros(len(reader), np.intp)
    depths = np.full(len(reader), np.nan)
    for i in indices:
        image = reader.anchor(i)
        frame = read_frame(folder, image.name, image.camera)
        blur[i] = measure_blur(frame.image, long_side_px)
        num_shared[i], depths[i] = measure_overlap(reader, i, long_side_px, enough=MIN_SHARED)
    known = depths[np.isfinite(depths)]
    return blur, num_shared, float(np.median(known)) if len(known) else np.nan


def measure_blur(image: NDArray[np.uint8], long_side_px: int) -> float:
    """Return how blurred an image (H, W) is, 0 to 1, as a network sees it.

    Crete, Dolmiere, Ladret and Nicolas, "The blur effect: perception and estimation with a new
    no-reference perceptual blur metric", 2007: the share of the differences between neighbouring
    pixels that stays when the image is blurred once more, on the axis where more of them stays.
    Unlike the variance of the Laplacian it hardly depends on how much there is to see.
    """
    zoom = max(image.shape) / long_side_px
    if zoom > 1:
        image = np.asarray(
            cv2.resize(image, None, fx=1 / zoom, fy=1 / zoom, interpolation=cv2.INTER_AREA)
        )
    sharp = image.astype(np.float32)
    kept = []
    for axis, window in ((0, (1, BLUR_WINDOW)), (1, (BLUR_WINDOW, 1))):
        before = np.abs(np.diff(sharp, axis=axis))
        after = np.abs(np.diff(cv2.blur(sharp, window), axis=axis))
        lost = np.maximum(before - after, 0).sum()
        kept.append(1 - float(lost) / max(float(before.sum()), 1e-9))
    return max(kept)


def running_median(values: Array) -> Array:
    """Return the median (N,) of each value and up to `NUM_BESIDE` on either side."""
    return np.array(
        [np.median(values[max(0, i - NUM_BESIDE) : i + NUM_BESIDE + 1]) for i in range(len(values))]
    )


def find_needless(
    cam_from_world: Rigid3,
    order: Sequence[int],
    distance: float,
    angle_deg: float,
    are_alike: Callable[[int, int], bool] | None = None,
    *,
    first: int = 0,
) -> dict[int, int]:
    """Go through images, keep each that no kept one is near; return the others.

    Parameters
    ----------
    cam_from_world : Rigid3
        Of all images (N,).
    order : sequence of int
        The images in question, the best first.
    distance, angle_deg : float
        Images whose centers and rotations are no farther apart than this are near.
    are_alike : callable, optional
        What two images that are near have to be as well.
    first : int
        The images before this one are kept.

    Returns
    -------
    dict
        For each image that is not kept, one that is.
    """
    if not np.isfinite(distance) or not order:
        return {}
    centers, needless = cam_from_world.center, dict[int, int]()
    tree, is_kept = KDTree(centers), np.arange(len(centers)) < first
    for i in order:
        near = np.array(tree.query_ball_point(centers[i], distance), np.intp)
        near = near[is_kept[near]]
        angles = np.rad2deg(rotation_angle(cam_from_world.R[near] @ cam_from_world.R[i].T))
        closest = near[angles <= angle_deg].tolist()
        other = next((j for j in closest if are_alike is None or are_alike(i, j)), None)
        if other is None:
            is_kept[i] = True
        else:
            needless[i] = other
    return needless
