"""Pictures and depth of a world of textured rectangles, for any camera model.

A point of a rectangle with origin o and axes u, v is X = o + s u + t v. Seen along the ray
r = (x, y, 1), X = r / w with the inverse depth w, all in the camera's frame, so that

    (s, t, 1) / depth = [u v o]^-1 r        (a plane-induced homography)

and w = (third row) . r is affine in (x, y). The rays come from the camera's own `normalize`, so
that distortion costs nothing and is exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.rigid import Rigid3, rotate
from trigpoint_db.synthetic.world import World

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.uint8]

NEAR_M = 0.02  # nothing nearer than this is drawn
_SUPERSAMPLING = 2  # samples a pixel, in each direction
_OVERLAP_M = 1e-5  # cells reach this far over their edges: rounding opens no gap between them
_EDGE_ON_M = 1e-9  # a plane that passes this near to the camera is not seen


@dataclass(frozen=True, eq=False)
class Rays:
    """Normalised coordinates x and y (H, W) of a grid of samples.

    The range of x over each column and of y over each row, (2, W) and (2, H), tells where a
    part of the plane z = 1 can lie in the picture; `pitch` is the spacing of the samples.
    """

    x: Floats
    y: Floats
    x_range: Floats
    y_range: Floats
    pitch: float


@lru_cache(maxsize=8)
def camera_rays(camera: Camera, supersampling: int, dtype: type[np.floating]) -> Rays:
    """Undistort the samples of a camera, `supersampling` a pixel in each direction."""
    u = (np.arange(camera.width * supersampling) + 0.5) / supersampling - 0.5
    v = (np.arange(camera.height * supersampling) + 0.5) / supersampling - 0.5
    px = np.stack(np.meshgrid(u, v), axis=-1)
    xy = camera.normalize(px.reshape(-1, 2)).reshape(px.shape)
    x, y = (np.ascontiguousarray(xy[..., i], dtype=dtype) for i in range(2))
    # fmin and fmax ignore the nan of samples outside the lens model's range.
    x_range = np.stack([np.fmin.reduce(x, axis=0), np.fmax.reduce(x, axis=0)])
    y_range = np.stack([np.fmin.reduce(y, axis=1), np.fmax.reduce(y, axis=1)])
    return Rays(x, y, x_range, y_range, 1 / (camera.focal_px * supersampling))


@dataclass(frozen=True, eq=False)
class Patch:
    """What one cell shows: where in a window of the picture, and of which part of its texture."""

    surface: int
    window: tuple[slice, slice]
    mask: NDArray[np.bool_]
    s: Floats
    t: Floats
    sample_m: float  # what one sample covers on the surface, about


def draw(
    world: World, rays: Rays, cam_from_world: Rigid3, inverse_depth: Floats
) -> Iterator[Patch]:
    """Yield what is seen, nearest cells first, and fill the zeroed `inverse_depth` (H, W)."""
    axes = rotate(cam_from_world.R, world.axes)
    origins = cam_from_world.apply(world.origins)
    facing = np.einsum("si,si->s", axes[:, 2], origins) < -_EDGE_ON_M
    frames = np.stack([axes[:, 0], axes[:, 1], origins], axis=-1)
    homographies = np.linalg.inv(np.where(facing[:, None, None], frames, np.eye(3)))
    homographies = homographies.astype(rays.x.dtype)

    corners = cam_from_world.apply(world.cells.corners)
    cells = np.flatnonzero(
        facing[world.cells.surface] & (corners[..., 2].max(axis=1, initial=-np.inf) > NEAR_M)
    )
    outlines = _clip(corners[cells])
    centers = np.nanmean(outlines, axis=1)
    distances = np.linalg.norm(centers, axis=1)
    cosines = np.einsum("ci,ci->c", axes[world.cells.surface[cells], 2], -centers) / distances
    # Between the sizes along and across the slant: less blur, and supersampling forgives it.
    samples_m = rays.pitch * centers[:, 2] / np.sqrt(np.maximum(cosines, 0.05))
    low = np.nanmin(outlines[..., :2] / outlines[..., 2:], axis=1)
    high = np.nanmax(outlines[..., :2] / outlines[..., 2:], axis=1)

    for i in np.argsort(distances):
        columns = _span(rays.x_range, low[i, 0], high[i, 0])
        rows = _span(rays.y_range, low[i, 1], high[i, 1])
        surface = int(world.cells.surface[cells[i]])
        seen = _see(
            homographies[surface],
            world.cells.bounds[cells[i]],
            (rays.x[rows, columns], rays.y[rows, columns]),
            inverse_depth[rows, columns],
        )
        if seen is not None:
            yield Patch(surface, (rows, columns), *seen, samples_m[i])


def _see(
    H: Floats, bounds: Array, rays: tuple[Floats, Floats], nearest: Floats
) -> tuple[NDArray[np.bool_], Floats, Floats] | None:
    """Return where a cell is nearest, with s and t, and bring `nearest` up to date."""
    w = _affine(H[2], *rays)
    mask = w > nearest
    if not mask.any():
        return None
    with np.errstate(divide="ignore", invalid="ignore"):  # the horizon, outside the mask
        z = 1 / w
        s, t = _affine(H[0], *rays) * z, _affine(H[1], *rays) * z
    left, right, top, bottom = bounds
    mask &= (s >= left - _OVERLAP_M) & (s <= right + _OVERLAP_M)
    mask &= (t >= top - _OVERLAP_M) & (t <= bottom + _OVERLAP_M)
    np.fmax(nearest, w * mask, out=nearest)  # fmax: rays outside the lens model's range are nan
    return mask, s, t


def _clip(corners: Array) -> Array:
    """Clip quadrilaterals (C, 4, 3) at the near plane: their corners (C, 8, 3), nan if unused."""
    following = np.roll(corners, -1, axis=1)
    z, z_following = corners[..., 2], following[..., 2]
    crosses = (z > NEAR_M) != (z_following > NEAR_M)
    share = (NEAR_M - z) / np.where(crosses, z_following - z, 1.0)
    crossings = corners + share[..., None] * (following - corners)
    kept = np.concatenate([z > NEAR_M, crosses], axis=1)
    return np.where(kept[..., None], np.concatenate([corners, crossings], axis=1), np.nan)


def _span(ranges: Floats, low: float, high: float) -> slice:
    """Return the columns (or rows) that may show coordinates from low to high."""
    hit = np.flatnonzero((ranges[0] <= high) & (ranges[1] >= low))
    return slice(hit[0], hit[-1] + 1) if len(hit) else slice(0, 0)


def _affine(h: Floats, x: Floats, y: Floats) -> Floats:
    """Return h . (x, y, 1)."""
    value: Floats = h[0] * x
    value += h[1] * y
    value += h[2]
    return value


def render_depth(world: World, camera: Camera, cam_from_world: Rigid3) -> Array:
    """Depth along the optical axis (H, W) in metres at the pixels' centres; inf at nothing."""
    rays = camera_rays(camera, 1, np.float64)
    inverse_depth = np.zeros(rays.x.shape)
    for _ in draw(world, rays, cam_from_world, inverse_depth):
        pass
    with np.errstate(divide="ignore"):
        depth: Array = 1 / inverse_depth
    return depth


def render(world: World, camera: Camera, cam_from_world: Rigid3, *, seed: int | None) -> Image:
    """Take a gray picture (H, W), 0 where there is nothing.

    With a seed, as a real camera would: automatic exposure, vignetting, lens blur, and the noise
    of that seed. With None, the ideal picture.
    """
    rays = camera_rays(camera, _SUPERSAMPLING, np.float32)
    samples = np.zeros(rays.x.shape, dtype=np.uint8)
    for patch in draw(world, rays, cam_from_world, np.zeros_like(rays.x)):
        surface = world.surfaces[patch.surface]
        texel_m = surface.width / surface.pyramid[0].shape[1]
        level = round(np.log2(max(patch.sample_m / texel_m, 1.0)))
        texture = surface.pyramid[min(level, len(surface.pyramid) - 1)]
        column = patch.s * (texture.shape[1] / surface.width) - 0.5
        row = patch.t * (texture.shape[0] / surface.height) - 0.5
        texels = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        cv2.copyTo(texels, patch.mask.view(np.uint8), samples[patch.window])
    size = (camera.width, camera.height)
    image = np.asarray(cv2.resize(samples, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return image if seed is None else _expose(image, np.random.default_rng(seed))


def _expose(image: Image, rng: np.random.Generator) -> Image:
    """Let a small sensor behind a small lens see the ideal picture."""
    rows, columns = image.shape
    u, v = np.linspace(-1, 1, columns), np.linspace(-1, 1, rows)
    vignette = 1 - 0.12 * (u**2 + v[:, None] ** 2)
    gain = np.clip(120 / max(float(image.mean()), 1.0), 0.5, 2.0) ** 0.8
    light = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.6) * (gain * vignette)
    read_noise, shot_noise = 1.2, 0.02  # standard deviation at 0, and variance a gray level
    deviation = np.sqrt(read_noise**2 + shot_noise * gain * light)
    noise = deviation * rng.standard_normal(image.shape, dtype=np.float32)
    exposed: Image = np.clip(np.rint(light + noise), 0, 255).astype(np.uint8)
    return exposed
