"""Pose files as hloc writes them: `name qw qx qy qz tx ty tz` a line, cam_from_world."""

from __future__ import annotations

from trigpoint.rigid import Rigid3


def format_pose(name: str, cam_from_world: Rigid3) -> str:
    """Write a line; numbers in full, so that equal poses give equal bytes."""
    numbers = [*cam_from_world.quaternion.tolist(), *cam_from_world.t.tolist()]
    return " ".join([name, *map(repr, numbers)]) + "\n"
