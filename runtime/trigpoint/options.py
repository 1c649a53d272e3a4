"""What can be set about localizing; `docs/configuration.md` says what for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from trigpoint.errors import ConfigError


@dataclass(frozen=True)
class LocalizerOptions:
    """Settings of the localizer; pixels are those of the image as the network sees it."""

    num_anchors: int = 20  # at the most
    first_anchors: int = 6  # more follow where these leave the pose uncertain
    enough_position_std_ratio: float = 0.002  # of the inliers' median depth: certain
    max_latency_ms: float | None = None  # no more anchors where they would take longer
    anchor_diversity: float = 0.3  # of the likeness to a better anchor, taken off; see search
    prefer_sessions: tuple[str, ...] = ()  # names; see search
    exclude_sessions: tuple[str, ...] = ()
    max_keypoints: int = 1024
    # "best": latent points first; anchor pairs too where these have few supporters
    generator: Literal["best", "anchor_pairs", "latent_points"] = "best"
    min_support: int = 12  # latent points that make a second hypothesis needless
    center: Literal["robust", "least_squares"] = "robust"  # the latter is Proposition 1 as it is
    num_relative_poses: int = 8
    min_relative_inliers: int = 15
    max_epipolar_error_px: float = 1.5
    max_direction_error_deg: float = 5.0
    max_rotation_error_deg: float = 3.0
    min_ray_angle_deg: float = 1.5
    max_hypothesis_error_px: float = 3.0
    max_guided_error_px: float = 2.0
    max_ray_error_px: float = 2.0
    max_reprojection_error_px: float = 4.0
    keypoint_sigma_px: float = 0.5
    num_refined_anchors: int = 8  # those with the most guided matches
    anchor_position_noise: float = 0.004  # of its distance; how far an anchor may move
    anchor_rotation_noise_deg: float = 0.02
    covariance_scale: float = 4.0  # errors have longer tails than a normal distribution
    min_features: int = 50
    min_inliers: int = 12
    min_confidence: float = 0.95
    enough_confidence: float = 0.99
    max_rival_ratio: float = 0.3  # of the inliers: points that agree on another pose
    min_spread_px: float = 10.0  # of the inliers, standard deviation
    max_depth_std_ratio: float = 0.2  # of the inliers' distances, the median
    max_position_std_ratio: float = 0.05  # of the inliers' median depth
    max_position_std_m: float | None = None
    try_turned: bool = False  # lost frames also on their sides and upside down

    def __post_init__(self) -> None:
        if self.num_anchors < 2:
            raise ConfigError("num_anchors must be at least 2: one anchor does not tell the scale")
        if self.first_anchors < 2:
            raise ConfigError("first_anchors must be at least 2: one anchor tells no depth")
        for name, value in vars(self).items():
            if isinstance(value, bool) or name == "anchor_diversity":
                continue
            if isinstance(value, int | float) and not 1e-6 < value < 1e6:
                raise ConfigError(f"{name} must be positive and below a million, not {value}")
        if not 0 <= self.anchor_diversity <= 1:
            raise ConfigError(f"anchor_diversity must be 0 to 1, not {self.anchor_diversity}")
        if both := set(self.prefer_sessions) & set(self.exclude_sessions):
            raise ConfigError(
                f"session {min(both)!r} is in prefer_sessions and in exclude_sessions; remove one"
            )
        for name in ("min_confidence", "enough_confidence"):
            if getattr(self, name) > 1:
                raise ConfigError(f"{name} must be at most 1, not {getattr(self, name)}")
