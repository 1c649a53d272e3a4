"""The methods, by name."""

from __future__ import annotations

from enum import StrEnum

from trigpoint.errors import ConfigError
from trigpoint_db.methods import midpoint, relative_poses, retrieval, translation_averaging
from trigpoint_db.methods.matched import Method


class MethodName(StrEnum):
    """The localizer's own and those it is compared with, the simplest first."""

    RETRIEVAL = "retrieval"
    MIDPOINT = "midpoint"
    TRANSLATION_AVERAGING = "translation-averaging"
    RELATIVE_POSES = "relative-poses"
    MAP_PNP = "map-pnp"
    LATENT_POINTS = "latent-points"  # the localizer itself, with its rounds and its verdict


_WITHOUT_EXTRAS: dict[MethodName, Method] = {
    MethodName.RETRIEVAL: retrieval.estimate_pose,
    MethodName.MIDPOINT: midpoint.estimate_pose,
    MethodName.TRANSLATION_AVERAGING: translation_averaging.estimate_pose,
    MethodName.RELATIVE_POSES: relative_poses.estimate_pose,
}


def load_method(name: MethodName) -> Method:
    """Find a method other than the localizer; ConfigError where its extra is not installed."""
    if name != MethodName.MAP_PNP:
        return _WITHOUT_EXTRAS[name]
    try:
        from trigpoint_db.methods import map_pnp
    except ImportError as error:
        raise ConfigError(
            "the method map-pnp needs pycolmap; install it with: pip install 'trigpoint[colmap]'"
        ) from error
    return map_pnp.estimate_pose
