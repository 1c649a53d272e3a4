"""EdgePoint2 (https://github.com/HITCSC/EdgePoint2, MIT), run from its authors' checkout.

Its network is exported to ONNX, so that it runs where ours run; what its wrapper does after the
network is done here in numpy: maxima in 5 x 5 px with a logit above -5, none within 4 px of the
edge, the best N, at whole pixels.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from trigpoint.errors import ConfigError
from trigpoint.frame import LocalFeatures

Array32 = NDArray[np.float32]

MULTIPLE_OF = 32
BORDER = 4
MIN_SCORE = -5.0
MIN_CURVATURE = np.float32(1e-6)


def open_session(path: Path) -> ort.InferenceSession:
    """Open an ONNX file, to run on one thread."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])


class EdgePoint2:
    """An exported network; `subpixel` refines its keypoints as ours are, by parabolas."""

    def __init__(self, path: Path, *, subpixel: bool) -> None:
        self._session = open_session(path)
        self._subpixel = subpixel

    def extract(self, image: NDArray[np.uint8], max_keypoints: int = 1024) -> LocalFeatures:
        """Extract at most `max_keypoints` features of a gray image (H, W), best score first."""
        height, width = (size // MULTIPLE_OF * MULTIPLE_OF for size in image.shape)
        fitted = image.astype(np.float32) / np.float32(255)
        if (height, width) != image.shape:
            fitted = cv2.resize(fitted, (width, height), interpolation=cv2.INTER_LINEAR)
        desc, score = self._session.run(["desc", "score"], {"image": fitted[None, None]})
        points, scores = _select(score[0, 0], max_keypoints, subpixel=self._subpixel)
        descriptors = _sample(desc[0], (points + 0.5) * (desc.shape[2] / height) - 0.5)
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
        zoom = np.divide(image.shape[::-1], (width, height)).astype(np.float32)
        none = np.empty(0, np.float32)
        return LocalFeatures((points + 0.5) * zoom - 0.5, descriptors, scores, none)


def _select(score: Array32, max_keypoints: int, *, subpixel: bool) -> tuple[Array32, Array32]:
    peaks = (score > MIN_SCORE) & (score >= cv2.dilate(score, np.ones((5, 5), np.uint8)))
    peaks[:BORDER] = peaks[-BORDER:] = False
    peaks[:, :BORDER] = peaks[:, -BORDER:] = False
    y, x = np.nonzero(peaks)
    best = np.argsort(-score[y, x], kind="stable")[:max_keypoints]
    y, x = y[best], x[best]
    points = np.stack([x, y], axis=1).astype(np.float32)
    if subpixel:
        points[:, 0] += _top(score[y, x - 1], score[y, x], score[y, x + 1])
        points[:, 1] += _top(score[y - 1, x], score[y, x], score[y + 1, x])
    return points, score[y, x]


def _top(before: Array32, at: Array32, after: Array32) -> Array32:
    """Offset in [-0.5, 0.5] of the top of a parabola through three neighbours."""
    curvature = np.maximum(2 * at - before - after, MIN_CURVATURE)
    return np.clip(0.5 * (after - before) / curvature, -0.5, 0.5)


def _sample(desc: Array32, points: Array32) -> Array32:
    """Interpolate a map (D, rows, columns) at x, y (N, 2), clamped at the edge."""
    last = np.array(desc.shape[:0:-1], np.float32) - 1
    x, y = np.clip(points, 0, last).T
    x0, y0 = (np.floor(v).astype(np.intp) for v in (x, y))
    x1, y1 = np.minimum(x0 + 1, int(last[0])), np.minimum(y0 + 1, int(last[1]))
    fx, fy = x - x0, y - y0
    top = desc[:, y0, x0] * (1 - fx) + desc[:, y0, x1] * fx
    bottom = desc[:, y1, x0] * (1 - fx) + desc[:, y1, x1] * fx
    return np.ascontiguousarray((top * (1 - fy) + bottom * fy).T)


def export(checkout: Path, configuration: str, path: Path) -> None:
    """Write the network of a checkout, such as its "E64", to an ONNX file. Needs torch."""
    try:
        import torch
    except ImportError as error:
        raise ConfigError(
            "EdgePoint2 needs torch; install it with: pip install 'trigpoint[train]'"
        ) from error
    sys.path.insert(0, str(checkout))
    try:
        from edgepoint2 import EdgePoint2Wrapper
        from model.model import EdgePoint2 as Network

        network = Network(**EdgePoint2Wrapper.cfgs[configuration])
        weights = torch.load(checkout / "weights" / f"{configuration}.pth", "cpu")
        network.load_state_dict(weights)
    except (ImportError, OSError, KeyError, RuntimeError) as error:
        raise ConfigError(
            f"{checkout} is not a checkout of EdgePoint2 with the weights of {configuration}: "
            f"{error}"
        ) from error
    finally:
        sys.path.remove(str(checkout))
    sizes = {2: "rows", 3: "columns"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(),
            (torch.zeros(1, 1, 480, 640),),
            path,
            opset_version=17,
            input_names=["image"],
            output_names=["desc", "score"],
            dynamic_axes=dict.fromkeys(("image", "desc", "score"), sizes),
            dynamo=False,
        )
