"""Procedural textures: gray pictures of materials, no two alike, full of detail worth tracking.

A material is a function of a generator and a shape in texels; TEXELS_PER_M gives the scale.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Shape = tuple[int, int]
Material = Callable[[Generator, Shape], Image]

TEXELS_PER_M = 400
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
)
_LETTERS = np.array(list("ABCDEFGHIKLMNOPRSTUVWXYZ0123456789"))


def texels(metres: float) -> int:
    """Length in texels, at least one."""
    return max(1, round(metres * TEXELS_PER_M))


def as_gray(values: NDArray[np.generic]) -> Image:
    """Round to gray levels."""
    gray: Image = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return gray


def fractal_noise(
    rng: Generator, shape: Shape, feature: float, *, octaves: int = 5, stretch: float = 1.0
) -> NDArray[np.float32]:
    """Noise of mean 0 and deviation 1; features from `feature` texels down by powers of two.

    `stretch` makes them longer along the rows, like the grain of wood.
    """
    noise = np.zeros((2, 2), dtype=np.float32)
    for octave in range(octaves):
        scale = max(feature / 2**octave, 1.0)
        size = (int(shape[1] / (scale * stretch)) + 2, int(shape[0] / scale) + 2)
        noise = np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC), np.float32)
        noise += 0.6**octave * rng.standard_normal(noise.shape, dtype=np.float32)
    noise = np.asarray(cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC), np.float32)
    noise -= noise.mean()
    noise /= noise.std() + np.float32(1e-6)
    return noise


def mottled(
    rng: Generator, image: Image, strength: float, feature: float = 120, stretch: float = 1.0
) -> Image:
    """Vary the gray levels by noise: dirt, wear, the grain of the material."""
    noise = fractal_noise(rng, (image.shape[0], image.shape[1]), feature, stretch=stretch)
    return as_gray(image * (1 + strength * noise))


def warped(rng: Generator, image: Image, amplitude: float, feature: float = 30) -> Image:
    """Bend straight edges by noise of some texels."""
    shape = (image.shape[0], image.shape[1])
    rows, columns = np.indices(shape, dtype=np.float32)
    rows += amplitude * fractal_noise(rng, shape, feature, octaves=2)
    columns += amplitude * fractal_noise(rng, shape, feature, octaves=2)
    bent = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(bent, dtype=np.uint8)


def speckled(rng: Generator, image: Image, per_m2: float, radius: tuple[int, int]) -> Image:
    """Draw dark and bright specks of a radius in texels."""
    rows, columns = image.shape
    count = rng.poisson(per_m2 * rows * columns / TEXELS_PER_M**2)
    for x, y in rng.integers(0, (columns, rows), (count, 2)):
        level = int(image[y, x]) + int(rng.choice((-1, 1)) * rng.integers(20, 60))
        axes = rng.integers(radius[0], radius[1], 2, endpoint=True)
        angle = float(rng.uniform(0, 180))
        cv2.ellipse(image, (int(x), int(y)), axes.tolist(), angle, 0, 360, level, -1, cv2.LINE_AA)
    return image


def courses(
    rng: Generator,
    shape: Shape,
    unit: tuple[float, float],
    *,
    gray: float,
    spread: float,
    joint: float,
    joint_gray: float,
    irregular: float = 0.3,
) -> Image:
    """Lay units (height, length in metres) in courses: bricks, planks, tiles, panels."""
    image = np.full(shape, joint_gray, dtype=np.uint8)
    height, length, gap = (texels(m) for m in (*unit, joint))
    y = -int(rng.integers(0, height))
    while y < shape[0]:
        course = round(height * rng.uniform(1 - irregular / 2, 1 + irregular / 2))
        x = -int(rng.integers(0, length))
        while x < shape[1]:
            width = round(length * rng.uniform(1 - irregular, 1 + irregular))
            level = float(np.clip(rng.normal(gray, spread), 15, 245))
            end = (x + width - gap, y + course - gap)
            cv2.rectangle(image, (x, y), end, level, -1)
            x += width
        y += course
    return image


def shapes(rng: Generator, image: Image, spacing: float, size: tuple[float, float]) -> Image:
    """Scatter random figures, about one in each square of `spacing` texels."""
    rows, columns = image.shape
    for top in np.arange(0, rows, spacing):
        for left in np.arange(0, columns, spacing):
            center = np.array([left, top]) + spacing * rng.uniform(0.1, 0.9, 2)
            _figure(rng, image, center, rng.uniform(*size))
    return image


def _figure(rng: Generator, image: Image, center: NDArray[np.float64], radius: float) -> None:
    level = float(rng.integers(15, 240))
    thickness = -1 if rng.random() < 0.6 else max(1, round(radius * rng.uniform(0.15, 0.4)))
    kind = rng.integers(0, 3)
    x, y = (round(c) for c in center)
    if kind == 0:
        axes = (max(1, round(radius)), max(1, round(radius * rng.uniform(0.4, 1))))
        angle = float(rng.uniform(0, 180))
        cv2.ellipse(image, (x, y), axes, angle, 0, 360, level, thickness, cv2.LINE_AA)
        return
    corners = int(rng.integers(3, 7))
    angles = rng.uniform(0, 2 * np.pi) + np.arange(corners) * 2 * np.pi / corners
    reach = radius * (rng.uniform(0.5, 1.1, corners) if kind == 1 else np.ones(corners))
    points = center + reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    polygon = np.round(points).astype(np.int32)[None]
    if thickness < 0:
        cv2.fillPoly(image, polygon, level, cv2.LINE_AA)
    else:
        cv2.polylines(image, polygon, True, level, thickness, cv2.LINE_AA)


def words(rng: Generator, image: Image, height: float, level: float) -> Image:
    """Fill with lines of random words, letters `height` texels high."""
    rows, columns = image.shape
    font, scale = int(rng.choice(_FONTS)), height / 22
    for baseline in np.arange(1.6 * height, rows - 0.4 * height, 1.7 * height):
        length = int(columns / height * rng.uniform(0.5, 0.95))
        line = "".join(rng.choice(_LETTERS, max(2, length)))
        line = " ".join(line[i : i + 5] for i in range(0, len(line), 5))
        origin = (round(0.6 * height), round(baseline))
        thickness = max(1, round(height / 9))
        cv2.putText(image, line, origin, font, scale, level, thickness, cv2.LINE_AA)
    return image
