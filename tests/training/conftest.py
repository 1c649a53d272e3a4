from pathlib import Path

import numpy as np
import pytest

from training import scenes
from training.scenes import View


@pytest.fixture(scope="session")
def views() -> list[View]:
    """Views of one place in a world of drawings."""
    rng = np.random.default_rng(5)
    return scenes.views_of_photo_world([scenes.drawing(rng) for _ in range(6)], seed=3, place=1)


def write_picture(folder: Path, image: np.ndarray, seed: int, view: View | None = None) -> None:
    """Write an entry of a corpus as if teachers had seen it."""
    rng = np.random.default_rng(seed)
    height, width = image.shape
    folder.mkdir(parents=True)
    np.save(folder / "image.npy", image)
    descriptors = rng.integers(-127, 128, (height // 4, width // 4, 192), dtype=np.int8)
    np.save(folder / "descriptors.npy", descriptors)
    keypoints = rng.uniform((8, 8), (width - 9, height - 9), (300, 2)).astype(np.float32)
    np.save(folder / "keypoints.npy", keypoints)
    if view:
        np.save(folder / "depth.npy", view.depth)
        np.save(folder / "pose.npy", np.c_[view.cam_from_world.R, view.cam_from_world.t])
        np.save(folder / "place.npy", view.place)


@pytest.fixture(scope="session")
def corpus(tmp_path_factory: pytest.TempPathFactory, views: list[View]) -> Path:
    """A corpus of three drawings and one rendered place."""
    folder = tmp_path_factory.mktemp("corpus")
    rng = np.random.default_rng(0)
    for index in range(3):
        write_picture(folder / f"{index:05d}", scenes.drawing(rng), index)
    for index, view in enumerate(views, 3):
        write_picture(folder / f"{index:05d}", view.image, index, view)
    (folder / "complete").touch()
    return folder
