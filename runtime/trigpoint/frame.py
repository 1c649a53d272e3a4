"""What goes into the localizer and what comes out."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import date
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture of one camera.

    Parameters
    ----------
    image : (height, width) uint8
        Gray levels.
    camera : Camera
        Of the same size as the image.
    time_ns : int
        Capture time, nanoseconds in the source's clock.
    name : str
        For people: a file name, a topic.
    """

    image: NDArray[np.uint8]
    camera: Camera
    time_ns: int = 0
    name: str = ""

    def __post_init__(self) -> None:
        height, width = self.image.shape
        if (width, height) != (self.camera.width, self.camera.height):
            raise ConfigError(
                f"the image is {width} x {height} px, but its camera's calibration is for "
                f"{self.camera.width} x {self.camera.height} px"
            )


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """Keypoints of one image, best score first, with descriptors, and its global descriptor.

    Parameters
    ----------
    keypoints : (N, 2) float32
        In px of the original image, top-left pixel centre at (0, 0).
    descriptors : (N, D) float32
        L2-normalised.
    scores : (N,) float32
        The detector's, falling.
    global_descriptor : (G,) float32
        L2-normalised, for retrieval.
    """

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scores: NDArray[np.float32]
    global_descriptor: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.keypoints)


@dataclass(frozen=True)
class ModelIdentity:
    """Which network made the features; features of different networks do not match."""

    name: str
    sha256: str  # of the files it is made of
    descriptor_dim: int
    global_dim: int


@dataclass(frozen=True)
class PoseNoise:
    """How well the poses of a map agree with each other: standard deviations along each axis.

    Parameters
    ----------
    position : float
        Of the vector between two cameras that are close together, in the map's unit.
    position_drift : float
        What comes to it with their distance, as a share of that.
    rotation_rad : float
        Of the rotation between two cameras that are close together.
    rotation_drift_rad : float
        What comes to it, for each unit of distance.
    """

    position: float
    position_drift: float
    rotation_rad: float
    rotation_drift_rad: float

    def std(self, distances: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return standard deviations (K, 6) of (dc, dtheta) of cameras at these distances (K,)."""
        position = np.hypot(self.position, self.position_drift * distances)
        rotation = np.hypot(self.rotation_rad, self.rotation_drift_rad * distances)
        return np.repeat(np.column_stack([position, rotation]), 3, axis=1)


@dataclass(frozen=True)
class Session:
    """A survey: images of a map that were taken on one occasion."""

    name: str
    date: date | None = None

    def __post_init__(self) -> None:
        if not (1 <= len(self.name) <= 100 and self.name.isprintable()):
            raise ConfigError(
                f"a session's name has 1 to 100 printable characters; it is {self.name[:100]!r}"
            )

    def __str__(self) -> str:
        return self.name if self.date is None else f"{self.name} ({self.date})"


@dataclass(frozen=True)
class Prior:
    """Where a camera is about, by GPS or its last pose: a ball in the map's frame.

    Parameters
    ----------
    center : (float, float, float)
        In the map's unit.
    radius : float
        The same; large enough for the camera and for the images that see what it sees.
    """

    center: tuple[float, float, float]
    radius: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.center).all() and 0 < self.radius < np.inf):
            raise ConfigError(
                f"a prior position is three numbers and a radius above 0, not {self.center} and "
                f"{self.radius}"
            )

    def contains(self, centers: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Say which centers (N, 3) are inside."""
        inside: NDArray[np.bool_] = (
            np.linalg.norm(centers - np.array(self.center), axis=1) <= self.radius
        )
        return inside


@dataclass(frozen=True, eq=False)
class Anchor:
    """A reference image of the map, with its known pose."""

    name: str
    camera: Camera
    cam_from_world: Rigid3
    keypoints: NDArray[np.float32]  # (N, 2) px
    descriptors: NDArray[np.int8]  # (N, D), as `quantize_descriptors` makes them


def quantize_descriptors(descriptors: NDArray[np.float32], levels: int = 127) -> NDArray[np.int8]:
    """Round L2-normalised descriptors (N, D) to integers up to `levels`.

    They reach to 4 / sqrt(D), four times the mean square of a unit vector's numbers, for all
    descriptors alike: their products compare as those of the descriptors do.
    """
    scale = np.float32(levels * np.sqrt(descriptors.shape[1]) / 4)
    codes: NDArray[np.int8] = np.clip(np.rint(descriptors * scale), -levels, levels).astype(np.int8)
    return codes


def restore_descriptors(codes: NDArray[np.int8]) -> NDArray[np.float32]:
    """L2-normalise quantized descriptors (N, D); zero stays zero."""
    descriptors = codes.astype(np.float32)
    norms = np.sqrt(np.einsum("ij,ij->i", descriptors, descriptors))
    descriptors /= np.maximum(norms, np.float32(1))[:, None]
    return descriptors


class Reason(StrEnum):
    """Why a frame was not localized."""

    NO_MAP = "NO_MAP"  # the map holds no image
    TOO_DARK = "TOO_DARK"  # hardly any light or contrast in the frame
    FEW_FEATURES = "FEW_FEATURES"  # the frame shows too few keypoints
    FEW_MATCHES = "FEW_MATCHES"  # no two anchors share enough of them: not a place in the map
    FEW_ANCHORS = "FEW_ANCHORS"  # fewer than two anchors agree on a pose
    DEGENERATE_ANCHORS = (
        "DEGENERATE_ANCHORS"  # they see the frame, or what it shows, along one line
    )
    FEW_INLIERS = "FEW_INLIERS"  # too few latent points agree with the refined pose
    CLUSTERED_INLIERS = "CLUSTERED_INLIERS"  # those that agree lie in one place, or on one line
    LOW_CONFIDENCE = "LOW_CONFIDENCE"  # what agrees with the pose may do so by accident
    AMBIGUOUS = "AMBIGUOUS"  # another pose explains as much: a repeated structure
    HIGH_UNCERTAINTY = "HIGH_UNCERTAINTY"  # a pose was found, but not a certain one


@dataclass(frozen=True)
class Statistics:
    """Counts and stage times of one localization; what was not reached is 0 or absent."""

    num_features: int = 0
    num_anchors: int = 0  # that were matched
    num_matches: int = 0  # over all anchors
    num_matcher_failures: int = 0  # anchors that a matching network failed on
    num_consistent_anchors: int = 0  # that agree in stage 1
    num_candidates: int = 0  # latent points of all matches, before any pose
    num_points: int = 0  # latent points
    num_inliers: int = 0  # latent points that agree with the final pose
    num_rivals: int = 0  # that agree with another one instead
    spread_px: float = 0.0  # of the inliers: standard deviation where it is least
    confidence: float = 0.0  # probability that the last pose, given or refused, is right
    std_ratio: float = 0.0  # of the position, but for what is wrong with the map, by the depth
    depth: float = 0.0  # of the inliers, the median; in the map's unit
    turned_deg: int = 0  # counterclockwise, of the image that the features are of
    generator: str = ""  # which hypothesis was refined: "anchor_pairs" or "latent_points"
    anchors: tuple[str, ...] = ()  # names, best first
    anchor_inliers: tuple[int, ...] = ()  # of the last pose, by anchor: those triangulated from it
    stage_ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Support:
    """What a refined pose rests on.

    Parameters
    ----------
    cam_from_world : Rigid3
        The pose, given or refused.
    points2d : (M, 2) float64
        The frame's keypoints that have a latent point, undistorted and normalised.
    points3d : (M, 3) float64
        Their latent points as refined, in the world.
    inliers : (M,) bool
        Which of them agree with the pose.
    anchors_from_world : Rigid3
        The anchors' poses (K,), in the order of `Statistics.anchors`.
    """

    cam_from_world: Rigid3
    points2d: NDArray[np.float64]
    points3d: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    anchors_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class Localized:
    """A pose that may be used.

    Parameters
    ----------
    cam_from_world : Rigid3
        The camera's pose.
    covariance : (6, 6) float64
        Of the error (dc, dtheta): the true center is center + dc, in the world's axes and units;
        the true world_from_cam rotation is exp(dtheta) world_from_cam.R, in radians about the
        world's axes. This is also ROS's order and frame.
    statistics : Statistics
        How it came about.
    support : Support
        The points and anchors that it rests on.
    """

    cam_from_world: Rigid3
    covariance: NDArray[np.float64]
    statistics: Statistics
    support: Support


@dataclass(frozen=True, eq=False)
class Lost:
    """No pose, and why; with what speaks for one that was refused."""

    reason: Reason
    statistics: Statistics
    detail: str = ""
    support: Support | None = None


@dataclass(frozen=True)
class Failed:
    """No localization at all: a BAD_FRAME that cannot be read, a BAD_MAP or a BAD_NETWORK."""

    reason: str
    detail: str


Result = Localized | Lost


def summarize(result: Result | Failed) -> str:
    """Say in a word what came of a frame: LOCALIZED, or the reason why not."""
    return "LOCALIZED" if isinstance(result, Localized) else result.reason


def describe(result: Result | Failed) -> dict[str, Any]:
    """Say in JSON's types what came of a frame."""
    if isinstance(result, Failed):
        return {"status": "FAILED", "reason": result.reason, "detail": result.detail}
    statistics = describe_statistics(result.statistics)
    if isinstance(result, Lost):
        return {"status": "LOST", "reason": result.reason, "detail": result.detail, **statistics}
    return {
        "status": "LOCALIZED",
        "reason": None,
        "center": result.cam_from_world.center.tolist(),
        "rotation_wxyz": result.cam_from_world.inverse().quaternion.tolist(),
        "covariance": result.covariance.tolist(),
        **statistics,
    }


def describe_statistics(statistics: Statistics) -> dict[str, Any]:
    """Say it in JSON's types, times to the microsecond."""
    stage_ms = {stage: round(ms, 3) for stage, ms in statistics.stage_ms.items()}
    return {**vars(statistics), "stage_ms": stage_ms}
