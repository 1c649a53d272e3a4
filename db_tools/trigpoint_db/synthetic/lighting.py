"""Light that falls on surfaces: lamps with soft shadows, and some from everywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_AMBIENT = 0.2
_OFFSET_M = 2e-3  # shadow rays start and end off the surfaces


def light_on(points: Array, normals: Array, lamps: Array, boxes_from_world: Array) -> Array:
    """Light (N,) on points of surfaces, about 1 below a lamp.

    Parameters
    ----------
    points, normals : (N, 3) float64
        In metres in the world; the normals point to the lit side.
    lamps : (L, 3) float64
        Points of the lamps, which shine downwards.
    boxes_from_world : (B, 3, 4) float64
        Each takes the inside of an opaque box to the cube -1..1.
    """
    starts = points + _OFFSET_M * normals
    light = _AMBIENT * (1 + 0.25 * normals[:, 2])
    for lamp in lamps:
        ray = lamp - starts
        distance = np.linalg.norm(ray, axis=1)
        direction = ray / distance[:, None]
        incidence = np.maximum(np.einsum("ni,ni->n", direction, normals), 0)
        fall_off = np.maximum(direction[:, 2], 0) / distance**2
        lit = np.flatnonzero(incidence * fall_off > 0)
        free = ~_hidden(starts[lit], ray[lit], boxes_from_world)
        light[lit] += free * (16.0 / len(lamps)) * incidence[lit] * fall_off[lit]
    return light


def _hidden(starts: Array, rays: Array, boxes_from_world: Array) -> NDArray[np.bool_]:
    """Whether a box cuts the segments start + (0..1) ray (slab test)."""
    hidden = np.zeros(len(starts), dtype=bool)
    for box in boxes_from_world:
        # Coordinates in rows: reducing over three columns would be slow.
        o, d = box[:, :3] @ starts.T + box[:, 3:], box[:, :3] @ rays.T
        d = np.where(np.abs(d) < 1e-12, 1e-12, d)
        a, b = (-1 - o) / d, (1 - o) / d
        enters, leaves = np.minimum(a, b).max(axis=0), np.maximum(a, b).min(axis=0)
        hidden |= (enters < leaves) & (leaves > 0) & (enters < 1 - 1e-3)
    return hidden
