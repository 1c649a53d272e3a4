"""The teachers: networks of others, run from their authors' checkouts and never part of ours.

    EdgePoint2-E64 (MIT)            https://github.com/HITCSC/EdgePoint2
    ALIKE-N (BSD 3-Clause)          https://github.com/Shiaoming/ALIKE

Their descriptors are joined, so that the inner product is the weighted mean of both similarities:
the two fail in different places, and together they match better than either (training/README.md).
"""

from __future__ import annotations

import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from training.precision import autocast

STRIDE = 4  # of the descriptors kept
ALIKE_WEIGHT = 0.85  # of its similarity, beside 1 for EdgePoint2's
NUM_WARPS = 6
KEYPOINT_AREA_PX = 200  # one keypoint in so many pixels at the most
MIN_PROBABILITY = 0.006


class Teachers:
    """Both networks, in evaluation mode on one device."""

    def __init__(self, edgepoint2: Path, alike: Path, device: torch.device) -> None:
        self.device = device
        with _import_path(edgepoint2):
            from model.model import EdgePoint2

            self.edgepoint2: Any = EdgePoint2(c1=16, c2=16, c3=48, c4=64, cdesc=64, cdetect=16)
        self.edgepoint2.load_state_dict(torch.load(edgepoint2 / "weights" / "E64.pth", "cpu"))
        with _import_path(alike), _torchvision_layers():
            from alnet import ALNet

            self.alike: Any = ALNet(c1=16, c2=32, c3=64, c4=128, dim=128, single_head=True)
        self.alike.load_state_dict(torch.load(alike / "models" / "alike-n.pth", "cpu"))
        for network in (self.edgepoint2, self.alike):
            network.eval().to(device, memory_format=torch.channels_last)

    @torch.no_grad()
    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.int8]:
        """Descriptors (H / 4, W / 4, 192) of a gray image, of about the same length."""
        x = self._tensor(image)
        edgepoint2, _ = self.edgepoint2(x)
        color = x.expand(-1, 3, -1, -1).contiguous(memory_format=torch.channels_last)
        with autocast(self.device):
            _, alike = self.alike(color)
        alike = F.avg_pool2d(F.normalize(alike.float(), dim=1), STRIDE)
        joined = torch.cat(
            [F.normalize(edgepoint2, dim=1), ALIKE_WEIGHT * F.normalize(alike, dim=1)], dim=1
        )
        scaled = (F.normalize(joined, dim=1) * 220).round().clamp(-127, 127)
        return scaled[0].permute(1, 2, 0).to(torch.int8).cpu().numpy()

    @torch.no_grad()
    def detect(self, image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
        """Keypoints x, y (N, 2), best first: peaks of the mean score over random warps.

        Homographic adaptation (DeTone et al., CVPRW 2018): what one pass puts a pixel beside
        the truth, the mean of several puts in its place. The warps enlarge, for finer places.
        """
        height, width = image.shape
        total = np.zeros(image.shape, np.float32)
        count = np.full(image.shape, 1e-6, np.float32)
        for index in range(NUM_WARPS + 1):
            warp = np.eye(3) if index == 0 else _random_warp(width, height, rng)
            warped = cv2.warpPerspective(image, warp, (width, height), flags=cv2.INTER_LINEAR)
            _, score = self.edgepoint2(self._tensor(np.asarray(warped, np.uint8)))
            probability = torch.sigmoid(score[0, 0]).cpu().numpy()
            probability[:4] = probability[-4:] = probability[:, :4] = probability[:, -4:] = 0
            seen = np.zeros(image.shape, np.float32)
            seen[4:-4, 4:-4] = 1
            for sums, values in ((total, probability), (count, seen)):
                sums += cv2.warpPerspective(
                    values, warp, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
                )
        mean = cv2.GaussianBlur(total / count, (0, 0), 0.7)
        peaks = (mean > MIN_PROBABILITY) & (mean >= cv2.dilate(mean, np.ones((5, 5), np.uint8)))
        peaks[:4] = peaks[-4:] = peaks[:, :4] = peaks[:, -4:] = False
        y, x = np.nonzero(peaks)
        log = np.log(np.maximum(mean, 1e-9))
        dx = _vertex(log[y, x - 1], log[y, x], log[y, x + 1])
        dy = _vertex(log[y - 1, x], log[y, x], log[y + 1, x])
        best = np.argsort(-mean[y, x], kind="stable")[: image.size // KEYPOINT_AREA_PX]
        return np.stack([x + dx, y + dy], axis=1)[best].astype(np.float32)

    def _tensor(self, image: NDArray[np.uint8]) -> Tensor:
        return torch.from_numpy(image).to(self.device).float()[None, None] / 255


def _vertex(
    before: NDArray[np.float32], at: NDArray[np.float32], after: NDArray[np.float32]
) -> NDArray[np.float32]:
    curvature = np.maximum(2 * at - before - after, 1e-3)
    return np.clip(0.5 * (after - before) / curvature, -0.5, 0.5)


def _random_warp(width: int, height: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Enlarge about a random place, turn and tilt a little."""
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    angle, zoom = rng.uniform(-0.4, 0.4), np.exp(rng.uniform(-0.1, 0.55))
    c, s = np.cos(angle) * zoom, np.sin(angle) * zoom
    middle = np.array([width, height]) * rng.uniform(0.3, 0.7, 2)
    moved = (corners - middle) @ np.array([[c, s], [-s, c]]) + middle
    moved += rng.uniform(-0.06, 0.06, (4, 2)) * (width, height)
    return cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32))


@contextmanager
def _import_path(checkout: Path) -> Iterator[None]:
    if not checkout.is_dir():
        raise SystemExit(f"{checkout} is no folder; clone the teacher there (training/README.md)")
    sys.path.insert(0, str(checkout))
    yield
    sys.path.remove(str(checkout))


@contextmanager
def _torchvision_layers() -> Iterator[None]:
    """Give ALIKE the two functions that it takes from torchvision, which we do not need else."""
    resnet = types.ModuleType("torchvision.models.resnet")
    resnet.conv1x1 = lambda i, o: nn.Conv2d(i, o, 1, bias=False)  # type: ignore[attr-defined]
    resnet.conv3x3 = lambda i, o, s=1: nn.Conv2d(  # type: ignore[attr-defined]
        i, o, 3, s, padding=1, bias=False
    )
    models = types.ModuleType("torchvision.models")
    models.resnet = resnet  # type: ignore[attr-defined]
    names = {"torchvision": types.ModuleType("torchvision"), "torchvision.models": models}
    names["torchvision.models.resnet"] = resnet
    before = {name: sys.modules.get(name) for name in names}
    sys.modules.update(names)
    yield
    for name, module in before.items():
        if module is None:
            del sys.modules[name]
        else:
            sys.modules[name] = module
