"""From an image to keypoints, local descriptors and the global descriptor, in one network pass."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.frame import LocalFeatures, ModelIdentity
from trigpoint.models.retrieval import Vocabulary
from trigpoint.models.session import (
    DESCRIPTORS,
    INPUT,
    SCORE,
    Contract,
    hash_files,
    open_session,
)

Array32 = NDArray[np.float32]

NMS_SIZE = 5  # px of the network's input
MIN_CURVATURE = np.float32(1e-3)  # logits / px^2
BORDER = 4  # px in which the network has seen too little to tell a keypoint


def packaged_model() -> Path:
    """Return the path of the network in the box."""
    return Path(str(resources.files("trigpoint.models") / "weights" / "pilot.int8.onnx"))


@dataclass(frozen=True, eq=False)
class FeatureModel:
    """A feature network with its retrieval vocabulary."""

    session: ort.InferenceSession
    contract: Contract
    vocabulary: Vocabulary
    identity: ModelIdentity

    @classmethod
    def load(cls, path: Path | None = None, *, num_threads: int = 2) -> FeatureModel:
        """Load a network (the packaged one by default) and the vocabulary beside it."""
        path = path or packaged_model()
        session, contract = open_session(path, num_threads)
        vocabulary_path = path.with_name(contract.vocabulary)
        vocabulary = Vocabulary.load(vocabulary_path, contract.descriptor_dim)
        identity = ModelIdentity(
            contract.name,
            hash_files(path, vocabulary_path),
            contract.descriptor_dim,
            vocabulary.global_dim,
        )
        return cls(session, contract, vocabulary, identity)

    def extract(self, image: NDArray[np.uint8], max_keypoints: int = 1024) -> LocalFeatures:
        """Extract at most `max_keypoints` features of a gray image (H, W), best score first."""
        small = _fit(image, self.contract)
        try:
            score, desc = self.session.run(
                [SCORE, DESCRIPTORS], {INPUT: _standardize(small, self.contract)[None, None]}
            )
        except Exception as error:  # onnxruntime's errors share no narrower base
            reason = str(error).splitlines()[0]
            raise ModelError(f"the network {self.contract.name!r} cannot run: {reason}") from error
        points, scores = select_keypoints(score[0, 0], max_keypoints, self.contract.min_score)
        dim, rows, columns = desc.shape[1:]
        dense = np.ascontiguousarray(desc[0].reshape(dim, -1).T)
        scale = np.array([columns / small.shape[1], rows / small.shape[0]], dtype=np.float32)
        local = sample_bilinear(dense.reshape(rows, columns, dim), (points + 0.5) * scale - 0.5)
        zoom: Array32 = np.divide(image.shape[::-1], small.shape[::-1]).astype(np.float32)
        return LocalFeatures(
            keypoints=(points + 0.5) * zoom - 0.5,
            descriptors=self.vocabulary.center(local),
            scores=scores,
            global_descriptor=self.vocabulary.describe(self.vocabulary.center(dense)),
        )


def _fit(image: NDArray[np.uint8], contract: Contract) -> NDArray[np.uint8]:
    """Scale to the network's long side and to multiples of its stride, axis by axis."""
    zoom = min(1.0, contract.long_side_px / max(image.shape))
    step = contract.multiple_of
    height, width = (max(step, round(size * zoom / step) * step) for size in image.shape)
    if (height, width) == image.shape:
        return image
    smaller = height < image.shape[0] or width < image.shape[1]
    interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation), np.uint8)


def _standardize(image: NDArray[np.uint8], contract: Contract) -> Array32:
    if contract.normalization == "unit":
        return image.astype(np.float32) / np.float32(255)
    mean, std = cv2.meanStdDev(image)
    standard = (image.astype(np.float32) - np.float32(mean[0, 0])) / np.float32(max(std[0, 0], 4.0))
    return np.clip(standard, -4, 4, out=standard)


def select_keypoints(
    score: Array32, max_keypoints: int, min_score: float
) -> tuple[Array32, Array32]:
    """Pick the strongest local maxima of a score map and refine them to sub-pixel.

    Parameters
    ----------
    score : (H, W) float32
        Logits.
    max_keypoints : int
        How many at the most.
    min_score : float
        Lowest logit of a keypoint.

    Returns
    -------
    points : (N, 2) float32
        x, y in px, refined by a parabola through the neighbours in each direction.
    scores : (N,) float32
        Falling.
    """
    peaks = (score > min_score) & (
        score >= cv2.dilate(score, np.ones((NMS_SIZE, NMS_SIZE), np.uint8))
    )
    peaks[:BORDER] = peaks[-BORDER:] = False
    peaks[:, :BORDER] = peaks[:, -BORDER:] = False
    y, x = np.nonzero(peaks)
    values = score[y, x]
    dx, curvature_x = _parabola(score[y, x - 1], values, score[y, x + 1])
    dy, curvature_y = _parabola(score[y - 1, x], values, score[y + 1, x])
    # A plateau, such as a blank image gives, is no keypoint.
    pointed = np.flatnonzero(np.minimum(curvature_x, curvature_y) > MIN_CURVATURE)
    best = pointed[np.argsort(-values[pointed], kind="stable")[:max_keypoints]]
    points = np.stack([x + dx, y + dy], axis=1)[best]
    return points.astype(np.float32), values[best]


def _parabola(before: Array32, at: Array32, after: Array32) -> tuple[Array32, Array32]:
    """Offset in [-0.5, 0.5] of the top of a parabola through three neighbours; its curvature."""
    curvature = 2 * at - before - after
    offset = 0.5 * (after - before) / np.maximum(curvature, MIN_CURVATURE)
    return np.clip(offset, -0.5, 0.5), curvature


def sample_bilinear(values: Array32, points: Array32) -> Array32:
    """Interpolate a map (rows, columns, D) at x, y (N, 2) in its pixels, clamped at the edge."""
    rows, columns = values.shape[:2]
    x = np.clip(points[:, 0], 0, columns - 1)
    y = np.clip(points[:, 1], 0, rows - 1)
    x0 = np.minimum(x.astype(np.intp), max(columns - 2, 0))
    y0 = np.minimum(y.astype(np.intp), max(rows - 2, 0))
    x1, y1 = np.minimum(x0 + 1, columns - 1), np.minimum(y0 + 1, rows - 1)
    fx, fy = (x - x0)[:, None].astype(np.float32), (y - y0)[:, None].astype(np.float32)
    top = values[y0, x0] * (1 - fx) + values[y0, x1] * fx
    bottom = values[y1, x0] * (1 - fx) + values[y1, x1] * fx
    mixed: Array32 = top * (1 - fy) + bottom * fy
    return mixed
