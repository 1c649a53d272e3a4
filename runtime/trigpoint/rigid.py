"""Rigid transforms, named `b_from_a`: they take coordinates in frame a to frame b."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rigid3:
    """A rotation and a translation, or a batch of them: x_b = R x_a + t.

    Parameters
    ----------
    R : (..., 3, 3) float64
        Rotation matrices.
    t : (..., 3) float64
        Translations, in the units of the frames.

    Notes
    -----
    The leading dimensions are a batch; they broadcast as in numpy. With `cam_from_world`, the
    camera center in the world is `center` = -R^T t (paper, below eq. 1).
    """

    R: Array
    t: Array

    @classmethod
    def identity(cls) -> Rigid3:
        """Return the transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(cls, wxyz: ArrayLike, t: ArrayLike) -> Rigid3:
        """Make one from quaternions (..., 4), w first, normalised here, and translations."""
        return cls(rotation_from_quaternion(wxyz), np.asarray(t, dtype=np.float64))

    @classmethod
    def from_center(cls, R: Array, center: Array) -> Rigid3:
        """Make `b_from_a` from its rotation and the origin of b as seen in a."""
        return cls(R, -rotate(R, center))

    @classmethod
    def stack(cls, transforms: Iterable[Rigid3]) -> Rigid3:
        """Collect single transforms into a batch (K,)."""
        items = list(transforms)
        return cls(
            np.array([item.R for item in items]).reshape(-1, 3, 3),
            np.array([item.t for item in items]).reshape(-1, 3),
        )

    def __getitem__(
        self, index: int | slice | NDArray[np.generic] | tuple[slice | None, ...] | None
    ) -> Rigid3:
        return Rigid3(self.R[index], self.t[index])

    def __len__(self) -> int:
        return len(self.t)

    def __matmul__(self, other: Rigid3) -> Rigid3:
        """Compose: `c_from_b @ b_from_a` is `c_from_a`."""
        return Rigid3(self.R @ other.R, self.apply(other.t))

    def inverse(self) -> Rigid3:
        """Return `a_from_b`."""
        R_inverse = np.swapaxes(self.R, -1, -2)
        return Rigid3(R_inverse, -rotate(R_inverse, self.t))

    def apply(self, points: Array) -> Array:
        """Transform points (..., 3); the batch dimensions broadcast."""
        return rotate(self.R, points) + self.t

    @property
    def center(self) -> Array:
        """The origin of frame b in frame a, (..., 3): -R^T t."""
        return -rotate(np.swapaxes(self.R, -1, -2), self.t)

    @property
    def quaternion(self) -> Array:
        """Unit quaternions (..., 4), w first, w >= 0."""
        return quaternion_from_rotation(self.R)


def rotate(R: Array, v: Array) -> Array:
    """R v for matrices (..., 3, 3) and vectors (..., 3), broadcast."""
    rotated: Array = np.einsum("...ij,...j->...i", R, v)
    return rotated


def rotation_from_quaternion(wxyz: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), w first, of any positive norm."""
    q = np.asarray(wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    R = np.empty((*q.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w)
    R[..., 0, 2], R[..., 1, 0] = 2 * (x * z + y * w), 2 * (x * y + z * w)
    R[..., 1, 1], R[..., 1, 2] = 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[..., 2, 0], R[..., 2, 1] = 2 * (x * z - y * w), 2 * (y * z + x * w)
    R[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return R


def quaternion_from_rotation(R: Array) -> Array:
    """Return unit quaternions (..., 4), w first and w >= 0, of rotations (..., 3, 3).

    The eigenvector of Bar-Itzhack's symmetric matrix for the largest eigenvalue (Bar-Itzhack,
    2000): no branches, exact for rotations, the nearest quaternion for noisy ones.
    """
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = np.moveaxis(R, (-2, -1), (0, 1))
    rows = [
        [r00 + r11 + r22, r21 - r12, r02 - r20, r10 - r01],
        [r21 - r12, r00 - r11 - r22, r01 + r10, r02 + r20],
        [r02 - r20, r01 + r10, r11 - r00 - r22, r12 + r21],
        [r10 - r01, r02 + r20, r12 + r21, r22 - r00 - r11],
    ]
    N = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    q: Array = np.linalg.eigh(N)[1][..., -1]
    return np.where(q[..., :1] < 0, -q, q)


def skew(v: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): skew(v) u = v x u."""
    x, y, z = np.moveaxis(v, -1, 0)
    matrices = np.zeros((*v.shape, 3))
    matrices[..., 0, 1], matrices[..., 0, 2] = -z, y
    matrices[..., 1, 0], matrices[..., 1, 2] = z, -x
    matrices[..., 2, 0], matrices[..., 2, 1] = -y, x
    return matrices


def rotation_from_vector(rotvec: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    V = skew(rotvec)
    half = np.sinc(angle / (2 * np.pi))
    R: Array = np.eye(3) + np.sinc(angle / np.pi) * V + 0.5 * half**2 * (V @ V)
    return R


def rotation_angle(R: Array) -> Array:
    """Angles (...) in radians of rotation matrices (..., 3, 3), accurate at 0 and at pi."""
    axis = R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]  # of length 2 sin(angle)
    cosine = (np.trace(R, axis1=-2, axis2=-1) - 1.0) / 2.0
    angle: Array = np.arctan2(np.linalg.norm(axis, axis=-1) / 2.0, cosine)
    return angle
