"""The sparse layout: keypoints and descriptors in lists, as the network has chosen them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.models.contract import FeaturesContract
from trigpoint.models.session import Network

Array32 = NDArray[np.float32]


def read_lists(
    network: Network[FeaturesContract],
    outputs: dict[str, NDArray[Any]],
    shape: tuple[int, ...],
    max_keypoints: int,
) -> tuple[Array32, Array32, Array32]:
    """Read the lists of a network that has seen an image of a shape (H, W).

    Returns
    -------
    points : (N, 2) float32
        x, y in px of the network's input, all within the image.
    descriptors : (N, D) float32
        Of any length.
    scores : (N,) float32
        Falling.
    """
    contract = network.contract
    points: Array32 = outputs["keypoints"].astype(np.float32).reshape(-1, 2)
    scores = outputs["scores"].astype(np.float32).ravel()
    descriptors = _rows(network, outputs["descriptors"], len(points))
    if len(scores) != len(points):
        raise ModelError(
            f"the network {contract.name!r} gave {len(points)} keypoints and {len(scores)} scores"
        )
    last: Array32 = np.subtract(shape[::-1], 1).astype(np.float32)
    if contract.keypoints == "normalized":
        points = ((points + 1) * (last / 2)).astype(np.float32)
    inside = (points >= -0.5).all(axis=1) & (points <= last + 0.5).all(axis=1)
    usable = inside & np.isfinite(descriptors).all(axis=1) & (scores > contract.min_score)
    kept = np.flatnonzero(usable)
    best = kept[np.argsort(-scores[kept], kind="stable")[:max_keypoints]]
    return points[best], descriptors[best], scores[best]


def _rows(network: Network[FeaturesContract], values: NDArray[Any], num: int) -> Array32:
    """Turn descriptors (1, N, D), (N, D) or (1, D, N) to (N, D)."""
    dim = network.contract.descriptor_dim
    table: Array32 = values.astype(np.float32, copy=False).reshape(-1, values.shape[-1])
    # As many keypoints as numbers: what the file declares tells which are which.
    declared = network.declared("descriptors")[-2:]
    turned = table.shape != (num, dim) or (declared[:1] == [dim] and declared[1:] != [dim])
    table = table.T if turned else table
    if table.shape != (num, dim):
        raise ModelError(
            f"the network {network.contract.name!r} gave {num} keypoints and descriptors of shape "
            f"{values.shape}; they should be ({num}, {dim}) or ({dim}, {num})"
        )
    return table
