"""What cameras do to a picture: blur, motion, exposure, night, noise, rolling light, JPEG."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Float = NDArray[np.float32]

_NORMAL = np.random.default_rng(0).standard_normal(1 << 20, np.float32)  # drawn once: it is dear


def spoil(image: Image, rng: Generator) -> Image:
    """Take the picture with a worse camera; each effect happens now and then."""
    light = image.astype(np.float32) / 255
    if rng.random() < 0.35:
        light = _blur(light, rng)
    if rng.random() < 0.35:
        light = light * _illumination(light.shape, rng)
    light = np.clip(light, 0, 1) ** np.exp(rng.uniform(-0.6, 0.6))
    night = rng.random() < 0.12
    if night:
        light = light * rng.uniform(0.06, 0.25)
    else:
        light = (light - 0.5) * rng.uniform(0.5, 1.4) + 0.5 + rng.uniform(-0.2, 0.2)
    if night or rng.random() < 0.6:
        light = _noise(light, rng, shot=0.06 if night else 0.05)
    if night and rng.random() < 0.7:  # the camera's gain
        light = light / max(float(np.quantile(light, 0.98)), 0.02) * rng.uniform(0.5, 1.0)
    spoilt = (np.clip(light, 0, 1) * 255).astype(np.uint8)
    if rng.random() < 0.35:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(20, 92))]
        _, data = cv2.imencode(".jpg", spoilt, quality)
        spoilt = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    return spoilt


def _blur(light: Float, rng: Generator) -> Float:
    if rng.random() < 0.55:  # out of focus
        return cv2.GaussianBlur(light, (0, 0), rng.uniform(0.4, 1.8))
    size = int(rng.integers(3, 10)) | 1  # motion
    kernel = np.zeros((size, size), np.float32)
    kernel[size // 2] = 1
    middle = (size / 2 - 0.5, size / 2 - 0.5)
    turn = cv2.getRotationMatrix2D(middle, rng.uniform(0, 180), 1)
    kernel = cv2.warpAffine(kernel, turn, (size, size))
    return cv2.filter2D(light, -1, kernel / max(float(kernel.sum()), 1e-6))


def _illumination(shape: tuple[int, ...], rng: Generator) -> Float:
    """Soft shadows, or the bands of a rolling shutter under flickering lamps."""
    height, width = shape
    if rng.random() < 0.75:
        grid = rng.uniform(0.35, 1.5, (rng.integers(2, 6), rng.integers(2, 6))).astype(np.float32)
        smooth = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        return np.clip(smooth, 0.25, 1.7)
    rows = np.arange(height, dtype=np.float32)[:, None] / height
    phase, periods = rng.uniform(0, 2 * np.pi), rng.uniform(1, 5)
    depth = np.float32(rng.uniform(0.1, 0.35))
    band = 1 + depth * np.sin(2 * np.pi * periods * rows + phase)
    return np.broadcast_to(band.astype(np.float32), (height, width))


def _noise(light: Float, rng: Generator, shot: float) -> Float:
    read, photons = rng.uniform(0.002, 0.025), rng.uniform(0, shot)
    sigma = np.sqrt(read**2 + photons**2 * np.clip(light, 0, 1)).astype(np.float32)
    start = rng.integers(_NORMAL.size - light.size)
    return light + sigma * _NORMAL[start : start + light.size].reshape(light.shape)
