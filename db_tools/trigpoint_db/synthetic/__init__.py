"""A small textured world with exact truth: pictures, depth and poses for demos and tests."""

from trigpoint_db.synthetic.renderer import render, render_depth
from trigpoint_db.synthetic.room import make_room
from trigpoint_db.synthetic.trajectories import flight_poses, look_along, look_at, survey_poses
from trigpoint_db.synthetic.world import Surface, World

__all__ = [
    "Surface",
    "World",
    "flight_poses",
    "look_along",
    "look_at",
    "make_room",
    "render",
    "render_depth",
    "survey_poses",
]
