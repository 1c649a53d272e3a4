"""The global descriptor: NetVLAD over the network's own descriptors, learnt on training pictures.

Words and whitening come from the corpus, never from a user's map.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from training.camera_effects import spoil
from training.corpus import Picture
from training.network import DESCRIPTOR_DIM, Network
from training.precision import autocast
from training.standardize import standardize

GLOBAL_DIM = 256
VIEW = (384, 288)  # width, height of the pictures learnt from
VIEWS_OF_FLAT = 2
SHRINKAGE = 0.2  # of the covariance within a place towards a sphere


class GlobalHead(nn.Module):
    """NetVLAD (Arandjelovic et al., CVPR 2016): soft assignment, intra-normalisation, whitening.

    Takes what the descriptors are made of (B, fusion, h, w), gives unit vectors (B, GLOBAL_DIM).
    """

    def __init__(self, network: Network) -> None:
        super().__init__()
        words = network.profile.words
        self.desc = network.mean_desc()
        self.assign = nn.Linear(DESCRIPTOR_DIM, words)
        self.words = nn.Parameter(torch.zeros(words, DESCRIPTOR_DIM))
        self.whiten = nn.Linear(words * DESCRIPTOR_DIM, GLOBAL_DIM)

    def describe(self, fused: Tensor) -> Tensor:
        """Return the descriptors of all cells (B, h w, 64), unit length."""
        cells = self.desc(fused).flatten(2).transpose(1, 2)
        return cells / cells.norm(dim=2, keepdim=True)  # F.normalize would expand the norms

    def vlad(self, cells: Tensor) -> Tensor:
        """Sum the residuals of (B, N, 64) to the words: (B, 64 words), normalised."""
        # A sixty-fourth of the sums, so that 16-bit floats hold their squares.
        share = self.assign(cells).softmax(dim=2).transpose(1, 2) / 64
        sums = share @ cells - share.sum(dim=2, keepdim=True) * self.words
        return F.normalize(F.normalize(sums, dim=2).flatten(1), dim=1)

    def forward(self, fused: Tensor) -> Tensor:
        """Return the global descriptors."""
        return F.normalize(self.whiten(self.vlad(self.describe(fused))), dim=1)


def learn_head(
    network: Network, flat: list[Picture], places: list[list[Picture]], seed: int
) -> GlobalHead:
    """Learn words, sharpness and whitening from pictures of known places."""
    network.eval()
    head = GlobalHead(network)
    rng = np.random.default_rng(seed)
    owners: list[int] = []
    seen: list[Tensor] = []
    with torch.no_grad():
        for place, image in _views(flat, places, rng):
            x = standardize(torch.from_numpy(image)[None, None].float())
            with autocast(torch.device("cpu")):
                _, fused = network.look(x)
            seen.append(head.describe(fused.float()).half())
            owners.append(place)
        _set_words(head, torch.cat([cells[0, ::7] for cells in seen]).float().numpy())
        vlad = torch.cat([head.vlad(cells.float()) for cells in seen]).double().numpy()
        projection, mean = learn_whitening(vlad, np.array(owners))
        head.whiten.weight.copy_(torch.from_numpy(projection))
        head.whiten.bias.copy_(torch.from_numpy(-projection @ mean))
    return head


def _views(
    flat: list[Picture], places: list[list[Picture]], rng: Generator
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield pictures of VIEW size with the number of the place that they show."""
    for place, picture in enumerate(flat):
        for _ in range(VIEWS_OF_FLAT):
            yield place, spoil(_crop(picture.image, rng), rng)
    for place, views in enumerate(places, len(flat)):
        for view in views:
            yield place, spoil(np.asarray(cv2.resize(view.image, VIEW)), rng)


def _crop(image: NDArray[np.uint8], rng: Generator) -> NDArray[np.uint8]:
    """Look at a good part of a picture from a little aside."""
    height, width = image.shape
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    inset = rng.uniform(-0.05, 0.22, (4, 2)) + rng.uniform(-0.08, 0.08, 2)
    source = (corners + inset * (1 - 2 * corners)) * (width, height)
    warp = cv2.getPerspectiveTransform(
        source.astype(np.float32), (corners * VIEW).astype(np.float32)
    )
    return np.asarray(cv2.warpPerspective(image, warp, VIEW, flags=cv2.INTER_AREA), np.uint8)


def _set_words(head: GlobalHead, cells: NDArray[np.float32]) -> None:
    """Cluster descriptors; the second nearest word gets a hundredth of the nearest one's share."""
    cv2.setRNGSeed(1)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
    sample = np.ascontiguousarray(cells[:: max(1, len(cells) // 60_000)])
    _, _, words = cv2.kmeans(sample, len(head.words), None, criteria, 1, cv2.KMEANS_PP_CENTERS)
    squared = np.sort((words**2).sum(axis=1) - 2 * sample @ words.T, axis=1)
    sharpness = np.log(100) / np.mean(squared[:, 1] - squared[:, 0])
    centers = torch.from_numpy(words)
    head.words.copy_(centers)
    head.assign.weight.copy_(2 * sharpness * centers)
    head.assign.bias.copy_(-sharpness * centers.square().sum(dim=1))


def learn_whitening(
    vectors: NDArray[np.float64], owners: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Learn a projection in which views of one place are close and places are far apart.

    Mikolajczyk and Matas (ICCV 2007): whiten by the covariance within places, then keep the
    directions of the largest variance over all. The covariance is shrunk towards a sphere, since
    there are fewer pictures than its dimensions need.

    Returns
    -------
    projection : (GLOBAL_DIM, D)
    mean : (D,)
    """
    mean = vectors.mean(axis=0)
    places, inverse, counts = np.unique(owners, return_inverse=True, return_counts=True)
    centers = np.zeros((len(places), vectors.shape[1]))
    np.add.at(centers, inverse, vectors)
    within = vectors - (centers / counts[:, None])[inverse]
    covariance = within.T @ within / (len(vectors) - len(places))
    covariance *= 1 - SHRINKAGE
    covariance += SHRINKAGE * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    values, columns = np.linalg.eigh(covariance)
    whiten = columns / np.sqrt(values) @ columns.T
    spread = (vectors - mean) @ whiten
    _, directions = np.linalg.eigh(spread.T @ spread)
    return directions[:, : -GLOBAL_DIM - 1 : -1].T @ whiten, mean
