"""What an image must be for a map to take it; all else is a DatabaseError that names the image."""

from __future__ import annotations

import numpy as np

from trigpoint.camera import Camera
from trigpoint.database import schema
from trigpoint.errors import DatabaseError
from trigpoint.frame import LocalFeatures, ModelIdentity
from trigpoint.rigid import Rigid3

MAX_COORDINATE = 1e9  # of a camera's center: beyond, a double has no tenth of a micrometre


def require_name(name: str) -> None:
    """Refuse a name that no key can hold."""
    try:
        size = len(name.encode())
    except UnicodeEncodeError as error:
        raise DatabaseError(f"the name {name!r} is not valid Unicode") from error
    if not 1 <= size <= schema.MAX_NAME_BYTES:
        raise DatabaseError(
            f"the name {name[:40]!r}... has {size} bytes; 1 to {schema.MAX_NAME_BYTES} are possible"
        )


def require_pose(name: str, cam_from_world: Rigid3) -> None:
    """Refuse what is no rigid motion."""
    R, t = cam_from_world.R, cam_from_world.t
    if R.shape != (3, 3) or t.shape != (3,):
        raise DatabaseError(f"the pose of {name!r} is a batch, {R.shape} and {t.shape}")
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise DatabaseError(f"the pose of {name!r} is not finite")
    if np.abs(cam_from_world.center).max() > MAX_COORDINATE:
        raise DatabaseError(
            f"{name!r} stands beyond {MAX_COORDINATE:g} units of the origin; move the origin, or "
            "mend the pose"
        )
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-5 or np.linalg.det(R) < 0:
        raise DatabaseError(f"the R of {name!r} is no rotation")


def require_features(
    name: str, features: LocalFeatures, camera: Camera, model: ModelIdentity
) -> None:
    """Refuse features that are not the model's, or that a record cannot hold."""
    num_keypoints = len(features)
    if num_keypoints > schema.MAX_KEYPOINTS:
        raise DatabaseError(
            f"{name!r} has {num_keypoints} keypoints; {schema.MAX_KEYPOINTS} are possible"
        )
    shapes = {
        "keypoints": (num_keypoints, 2),
        "descriptors": (num_keypoints, model.descriptor_dim),
        "global_descriptor": (model.global_dim,),
    }
    for field, shape in shapes.items():
        array = getattr(features, field)
        if array.shape != shape:
            raise DatabaseError(
                f"{name!r} has {field} {array.shape}; those of model {model.name!r} are {shape}"
            )
        if not np.isfinite(array).all():
            raise DatabaseError(f"{name!r} has {field} that are not finite")
    limit = (camera.width - 0.5, camera.height - 0.5)
    if ((features.keypoints < -0.5) | (features.keypoints > limit)).any():
        raise DatabaseError(
            f"{name!r} has keypoints outside its {camera.width} x {camera.height} px"
        )
