"""A corner of a rendered room, photographed from an arc: a folder with both splits."""

from pathlib import Path

import cv2
import numpy as np

from trigpoint.camera import Camera
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import write_model
from trigpoint_db.poses import Query, write_queries
from trigpoint_db.synthetic import look_along, make_room, render

CAMERA = Camera("PINHOLE", 320, 240, (260.0, 260.0, 159.5, 119.5))


def write_set(folder: Path, num_images: int) -> Path:
    """Every fifth image is a query; in the other split, the last fifth of them is."""
    (folder / "images").mkdir(parents=True)
    along = np.linspace(0, 1, num_images)
    centers = np.column_stack(
        [-1.2 + 0.9 * along, -0.3 - 0.9 * along, 1.3 + 0.2 * np.sin(9 * along)]
    )
    poses = look_along(centers, 0.6 + 0.3 * along, 0.1 * np.cos(7 * along), 0 * along)
    world = make_room(0)
    images = [PosedImage(f"{i:02}.png", CAMERA, poses[i]) for i in range(num_images)]
    for i, image in enumerate(images):
        picture = render(world, CAMERA, image.cam_from_world, seed=i)
        assert cv2.imwrite(str(folder / "images" / image.name), picture)
    write_model(folder / "sparse", images)
    for suffix, is_query in (
        ("", [i % 5 == 2 for i in range(num_images)]),
        ("_block", [i >= num_images - num_images // 5 for i in range(num_images)]),
    ):
        mapped = [image.name for image, asked in zip(images, is_query, strict=True) if not asked]
        asked_for = [
            Query(image.name, image.camera)
            for image, asked in zip(images, is_query, strict=True)
            if asked
        ]
        (folder / f"map{suffix}.txt").write_text("".join(f"{name}\n" for name in mapped))
        write_queries(folder / f"queries{suffix}.txt", asked_for)
    return folder
