"""How well held-out photographs match under known homographies."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from training.network import Network
from training.scenes import MIN_SIDE_PX, photograph_paths
from training.standardize import standardize
from trigpoint.models.dense import select_keypoints
from trigpoint.models.matching import match_mutual

SIZE = (480, 320)  # width, height
NUM_KEYPOINTS = 512
MAX_ERROR_PX = 3.0


class Validation:
    """Pairs of views of photographs that training does not see, the same at each call."""

    def __init__(self, photographs: Path, device: torch.device) -> None:
        self.device = device
        self.pairs: list[tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64]]] = []
        rng = np.random.default_rng(0)
        for path in photograph_paths(photographs, held_out=True):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None or min(image.shape) < MIN_SIDE_PX:
                continue
            first = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
            corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * SIZE
            moved = corners + rng.uniform(-0.18, 0.18, (4, 2)) * SIZE
            warp = cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32))
            second = cv2.warpPerspective(first, warp, SIZE).astype(np.float32)
            second = second * rng.uniform(0.6, 1.2) + rng.normal(0, 5, second.shape)
            self.pairs.append((first, np.clip(second, 0, 255).astype(np.uint8), warp))

    @torch.no_grad()
    def measure(self, network: Network) -> dict[str, float]:
        """Share of keypoints matched within 3 px, and how far these are off, in px."""
        network.eval()
        scores, errors = [], []
        for first, second, warp in self.pairs:
            (xy, one), (there, two) = (self._extract(network, image) for image in (first, second))
            matches, _ = match_mutual(one, two)
            moved = cv2.perspectiveTransform(xy[None, matches[:, 0]], warp)[0]
            distance = np.linalg.norm(moved - there[matches[:, 1]], axis=1)
            right = distance < MAX_ERROR_PX
            scores.append(right.sum() / max(min(len(xy), len(there)), 1))
            errors.append(distance[right])
        network.train()
        return {
            "matching_score": round(float(np.mean(scores)), 4),
            "localization_px": round(float(np.median(np.concatenate(errors))), 4),
        }

    def _extract(
        self, network: Network, image: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        x = torch.from_numpy(image).to(self.device).float()[None, None]
        score, descriptors = network(standardize(x))
        points, _ = select_keypoints(score[0, 0].cpu().numpy(), NUM_KEYPOINTS, -4.0)
        grid = (torch.from_numpy(points) + 0.5) / torch.tensor(SIZE) * 2 - 1
        sampled = F.grid_sample(descriptors.float().cpu(), grid[None, None], align_corners=False)
        return points, F.normalize(sampled[0, :, 0].T, dim=1).numpy()
