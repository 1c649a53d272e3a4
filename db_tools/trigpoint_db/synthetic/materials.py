"""What the room is made of: each material draws a fresh texture of the shape it is asked for."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator

from trigpoint_db.synthetic.textures import (
    Image,
    Shape,
    as_gray,
    courses,
    fractal_noise,
    mottled,
    shapes,
    speckled,
    texels,
    warped,
    words,
)


def _plain(shape: Shape, gray: float) -> Image:
    return np.full(shape, gray, dtype=np.uint8)


def bricks(rng: Generator, shape: Shape) -> Image:
    """Draw rough bricks with pale joints."""
    wall = courses(
        rng, shape, (0.085, 0.25), gray=115, spread=24, joint=0.012, joint_gray=175, irregular=0.2
    )
    wall = warped(rng, wall, 1.5)
    wall = speckled(rng, wall, 150, (1, 4))
    return mottled(rng, mottled(rng, wall, 0.08), 0.08, 12)


def plaster(rng: Generator, shape: Shape) -> Image:
    """Draw old plaster: stains, patches of repair, cracks and chips."""
    tone = 185 + 14 * fractal_noise(rng, shape, 300)
    patches = fractal_noise(rng, shape, 160, octaves=3) > 0.9
    wall = as_gray(np.where(patches, tone - rng.uniform(25, 50), tone))
    for _ in range(2 + rng.poisson(1.2 * shape[0] * shape[1] / texels(1.0) ** 2)):
        start = rng.uniform((0, 0), shape[::-1])
        turn = np.cumsum(rng.normal(0, 0.5, 40)) + rng.uniform(0, 2 * np.pi)
        steps = rng.uniform(5, 16, 40)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        crack = np.round(start + np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(wall, [crack], False, int(rng.integers(60, 110)), 2, cv2.LINE_AA)
    wall = speckled(rng, wall, 60, (1, 5))
    return mottled(rng, wall, 0.03, 8)


def wallpaper(rng: Generator, shape: Shape) -> Image:
    """Draw a print of random figures, large ones over small ones."""
    wall = shapes(rng, _plain(shape, rng.uniform(150, 200)), 36, (5, 13))
    wall = shapes(rng, wall, 170, (20, 48))
    return mottled(rng, wall, 0.06)


def tiles(rng: Generator, shape: Shape) -> Image:
    """Draw glazed tiles of many tones, some of them painted."""
    wall = courses(
        rng, shape, (0.16, 0.18), gray=150, spread=38, joint=0.01, joint_gray=70, irregular=0.15
    )
    wall = shapes(rng, wall, 190, (16, 34))
    return mottled(rng, speckled(rng, wall, 80, (1, 4)), 0.07)


def planks(rng: Generator, shape: Shape) -> Image:
    """Draw floor boards along the rows, with grain and knots."""
    floor = courses(
        rng, shape, (0.13, 1.1), gray=130, spread=22, joint=0.006, joint_gray=45, irregular=0.4
    )
    floor = speckled(rng, floor, 25, (2, 9))
    floor = mottled(rng, floor, 0.12, 12, stretch=14)
    floor = mottled(rng, floor, 0.06, 3, stretch=4)
    return mottled(rng, speckled(rng, floor, 60, (1, 3)), 0.06, 200)


def panelling(rng: Generator, shape: Shape) -> Image:
    """Draw upright boards."""
    return np.ascontiguousarray(planks(rng, shape[::-1]).T)


def ceiling_panels(rng: Generator, shape: Shape) -> Image:
    """Draw acoustic panels: many specks, some stains."""
    ceiling = courses(
        rng, shape, (0.6, 0.6), gray=205, spread=8, joint=0.015, joint_gray=120, irregular=0.1
    )
    ceiling = speckled(rng, ceiling, 130, (1, 6))
    stains = np.abs(fractal_noise(rng, shape, 250, octaves=4)) < 0.05
    ceiling = as_gray(ceiling - 30.0 * stains)
    return mottled(rng, ceiling, 0.04, 200)


def wood(rng: Generator, shape: Shape) -> Image:
    """Draw one board, its grain along the longer side."""
    if shape[0] > shape[1]:
        return np.ascontiguousarray(wood(rng, shape[::-1]).T)
    board = speckled(rng, _plain(shape, rng.uniform(90, 170)), 40, (2, 8))
    board = mottled(rng, board, 0.16, 16, stretch=12)
    return speckled(rng, board, 50, (1, 3))


def painted(rng: Generator, shape: Shape) -> Image:
    """Draw lacquer with scratches and chips."""
    base = _plain(shape, rng.choice((55, 80, 150, 190, 215)))
    return mottled(rng, speckled(rng, base, 120, (1, 4)), 0.05)


def enamel(rng: Generator, shape: Shape) -> Image:
    """Draw pale enamel with chips."""
    base = _plain(shape, rng.uniform(195, 220))
    return mottled(rng, speckled(rng, base, 150, (1, 4)), 0.05)


def fabric(rng: Generator, shape: Shape) -> Image:
    """Draw a weave with stripes of random widths both ways."""
    stripes = [np.repeat(rng.normal(0, 22, n), rng.integers(4, 60, n))[:n] for n in shape]
    cloth = as_gray(rng.uniform(90, 150) + stripes[0][:, None] + stripes[1])
    return mottled(rng, mottled(rng, warped(rng, cloth, 1.5), 0.08, 6), 0.08)


def rug(rng: Generator, shape: Shape) -> Image:
    """Draw a knotted rug: figures inside a border."""
    pile = shapes(rng, _plain(shape, 95), 60, (10, 28))
    pile = shapes(rng, pile, 220, (30, 70))
    for inset, level in ((0, 60), (30, 190), (46, 90)):
        end = (shape[1] - 1 - inset, shape[0] - 1 - inset)
        cv2.rectangle(pile, (inset, inset), end, level, 14)
    return mottled(rng, warped(rng, pile, 1.2, 8), 0.14, 5)


def cardboard(rng: Generator, shape: Shape) -> Image:
    """Draw a side of a parcel: tape, a label, print."""
    side = _plain(shape, rng.uniform(120, 165))
    rows, columns = shape
    tape = round(columns * rng.uniform(0.3, 0.6))
    cv2.rectangle(side, (tape, 0), (tape + texels(0.05), rows), rng.uniform(175, 205), -1)
    height = max(6.0, rows * rng.uniform(0.08, 0.14))
    top, left = round(rows * rng.uniform(0.1, 0.5)), round(columns * rng.uniform(0.05, 0.4))
    label = side[top : top + round(rows * 0.4), left : left + round(columns * 0.5)]
    label[:] = words(rng, _plain((label.shape[0], label.shape[1]), 225), height, 30)
    side = speckled(rng, side, 150, (1, 4))
    return mottled(rng, side, 0.07)


def book_spines(rng: Generator, shape: Shape) -> Image:
    """Draw a row of books, some leaning back into the dark, with bands and titles."""
    rows, columns = shape
    row, left = _plain(shape, 25), 0
    while left < columns:
        width = texels(rng.uniform(0.015, 0.055))
        level, top = rng.uniform(35, 225), round(rows * rng.uniform(0, 0.3))
        cv2.rectangle(row, (left, top), (left + width - 2, rows), level, -1)
        ink = level + 90 if level < 130 else level - 90
        for band in rng.uniform(top, rows, rng.integers(1, 4)):
            end = (left + width - 2, round(band + rng.integers(2, 8)))
            cv2.rectangle(row, (left, round(band)), end, ink, -1)
        title = _plain((width, max(2, round((rows - top) * 0.6))), level)
        words(rng, title, width * 0.42, ink)
        part = row[top + round((rows - top) * 0.2) :, left : left + width - 2]
        upright = cv2.rotate(title, cv2.ROTATE_90_CLOCKWISE)[: part.shape[0], : part.shape[1]]
        part[: upright.shape[0], : upright.shape[1]] = upright
        left += width
    return mottled(rng, row, 0.05)


def drawers(rng: Generator, shape: Shape) -> Image:
    """Draw drawer fronts of wood with dark gaps and handles."""
    front = wood(rng, shape)
    heights = rng.uniform(0.14, 0.3, 12)
    width = texels(rng.uniform(0.4, 0.7))
    for bottom, height in zip(np.cumsum(heights), heights, strict=True):
        for left in range(0, shape[1], width):
            top, end = texels(bottom - height), (left + width, texels(bottom))
            cv2.rectangle(front, (left, top), end, 30, 3)
            x = left + round(width * rng.uniform(0.35, 0.65))
            y = (top + end[1]) // 2
            cv2.rectangle(front, (x - 20, y - 4), (x + 20, y + 4), rng.uniform(20, 230), -1)
    return front


def page(rng: Generator, shape: Shape) -> Image:
    """Draw printed paper."""
    return mottled(rng, words(rng, _plain(shape, 225), rng.uniform(7, 12), 40), 0.03)


def screen(rng: Generator, shape: Shape) -> Image:
    """Draw a monitor showing windows."""
    glass = _plain(shape, 30)
    for _ in range(6):
        top, left = rng.integers(0, np.array(shape) * 2 // 3)
        window = glass[top : top + shape[0] // 2, left : left + shape[1] // 2]
        level = rng.uniform(60, 230)
        ink = 20 if level > 130 else 220
        window[:] = words(rng, _plain((window.shape[0], window.shape[1]), level), 9, ink)
        window[:8] = ink
    cv2.rectangle(glass, (0, 0), (shape[1] - 1, shape[0] - 1), 20, 12)
    return glass


def whiteboard(rng: Generator, shape: Shape) -> Image:
    """Draw a white board with writing and sketches."""
    board, middle = _plain(shape, 215), shape[1] // 2
    words(rng, board[:, :middle], 26, 60)
    shapes(rng, board[:, middle:], 110, (20, 50))
    cv2.rectangle(board, (0, 0), (shape[1] - 1, shape[0] - 1), 90, 14)
    return mottled(rng, board, 0.04)


def photograph(rng: Generator, shape: Shape) -> Image:
    """Draw a framed picture like a landscape: soft regions of many tones under a gradient."""
    levels = rng.uniform(30, 225, 9)
    regions = np.digitize(fractal_noise(rng, shape, 140, octaves=5), np.linspace(-1.6, 1.6, 8))
    slope = np.linspace(1.15, 0.75, shape[0])[:, None]
    picture = as_gray(cv2.GaussianBlur(levels[regions], (0, 0), 2) * slope)
    picture = mottled(rng, picture, 0.08, 40)
    cv2.rectangle(picture, (0, 0), (shape[1] - 1, shape[0] - 1), float(rng.choice((25, 220))), 20)
    return picture


def poster(rng: Generator, shape: Shape) -> Image:
    """Draw a poster: figures and large letters."""
    sheet = as_gray(
        np.linspace(rng.uniform(60, 210), rng.uniform(60, 210), shape[0])[:, None]
        * np.ones(shape[1])
    )
    sheet = shapes(rng, sheet, 75, (12, 50))
    height = rng.uniform(0.08, 0.12) * shape[0]
    title = sheet[-round(2.2 * height) :]
    title[:] = words(rng, _plain((title.shape[0], title.shape[1]), 225), height, 25)
    cv2.rectangle(sheet, (0, 0), (shape[1] - 1, shape[0] - 1), 235, 8)
    return mottled(rng, sheet, 0.04)


def lamp(rng: Generator, shape: Shape) -> Image:
    """Draw a light panel behind a grid."""
    panel = _plain(shape, 250)
    pitch = texels(rng.uniform(0.05, 0.07))
    panel[:, ::pitch], panel[::pitch] = 180, 180
    return speckled(rng, panel, 40, (1, 4))
