"""Surveys of patterns, quick to make: they can be mapped, but nothing localizes there."""

from pathlib import Path

import cv2
import numpy as np

from tests.unit.maps import make_pose
from trigpoint.camera import Camera
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import write_model

CAMERA = Camera("PINHOLE", 96, 64, (80.0, 80.0, 47.5, 31.5))


def make_survey(folder: Path, num_images: int) -> list[PosedImage]:
    """Write `images/` and the COLMAP model in `sparse/`."""
    (folder / "images").mkdir(parents=True)
    images = [PosedImage(f"{i:04d}.png", CAMERA, make_pose(i)) for i in range(num_images)]
    for index, image in enumerate(images):
        rng = np.random.default_rng(index)
        coarse = rng.integers(0, 256, (16, 24), np.uint8)
        pattern = cv2.resize(coarse, (CAMERA.width, CAMERA.height))
        cv2.imwrite(str(folder / "images" / image.name), pattern)
    write_model(folder / "sparse", images)
    return images
