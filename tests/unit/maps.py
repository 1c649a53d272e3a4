"""Maps of known contents."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import LocalFeatures, ModelIdentity, restore_descriptors
from trigpoint.rigid import Rigid3, rotation_from_vector

MODEL = ModelIdentity("test", "0" * 64, descriptor_dim=16, global_dim=32)
CAMERA = Camera("PINHOLE", 640, 480, (500.0, 510.0, 319.5, 239.5))


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    norms = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / norms, np.float32)


def make_features(
    seed: int, num_keypoints: int = 40, model: ModelIdentity = MODEL, camera: Camera = CAMERA
) -> LocalFeatures:
    rng = np.random.default_rng(seed)
    corner = np.array([camera.width, camera.height])
    # Bounded, so that no number of a descriptor is clipped.
    numbers = rng.uniform(-1, 1, (num_keypoints, model.descriptor_dim))
    return LocalFeatures(
        keypoints=(rng.random((num_keypoints, 2)) * corner - 0.5).astype(np.float32),
        descriptors=unit(numbers),
        scores=np.sort(rng.random(num_keypoints).astype(np.float32))[::-1],
        global_descriptor=unit(rng.standard_normal(model.global_dim)),
    )


def make_pose(seed: int) -> Rigid3:
    rng = np.random.default_rng(seed)
    return Rigid3(rotation_from_vector(rng.standard_normal(3)), rng.normal(0, 100, 3))


def add(writer: MapWriter, index: int, **changes: Any) -> int:
    """Add the image that belongs at an index, or a changed one."""
    image = {
        "name": f"folder/{index}.png",
        "camera": CAMERA,
        "cam_from_world": make_pose(index),
        "features": make_features(index),
    }
    return writer.add(**{**image, **changes})


def make_map(path: Path, num_images: int) -> Path:
    with MapWriter.create(path, MODEL) as writer:
        for index in range(num_images):
            add(writer, index)
    return path


def require_image(reader: MapReader, index: int) -> None:
    """The image that `add` put at an index is there."""
    anchor, features = reader.anchor(index), make_features(index)
    assert anchor.name == f"folder/{index}.png"
    np.testing.assert_allclose(anchor.cam_from_world.t, make_pose(index).t, rtol=1e-12)
    np.testing.assert_allclose(anchor.keypoints, features.keypoints, atol=0.01)
    np.testing.assert_allclose(
        restore_descriptors(anchor.descriptors), features.descriptors, atol=0.02
    )
