"""The feature network as it is measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.models.inputs import resize, to_tensor
from trigpoint.models.local import FeatureNetwork


def load_network(path: Path) -> FeatureNetwork:
    """Load a feature network of the dense layout, on one thread."""
    network = FeatureNetwork.load(path, num_threads=1)
    if network.contract.layout != "dense":
        raise ModelError(
            f"{path} is of the {network.contract.layout} layout; only dense feature networks are "
            "quantised, as it is their quality that can be measured here"
        )
    return network


def fit(image: NDArray[np.uint8], network: FeatureNetwork) -> NDArray[np.uint8]:
    """Scale an image to a size at which the network takes it as it is."""
    match network.network.declared("image"):
        case [_, _, int(height), int(width)]:
            return resize(image, height, width)
    step = network.contract.multiple_of
    zoom = min(1.0, network.long_side_px / max(image.shape))
    height, width = (max(step, round(side * zoom / step) * step) for side in image.shape)
    return resize(image, height, width)


def make_input(image: NDArray[np.uint8], network: FeatureNetwork) -> dict[str, NDArray[np.float32]]:
    """Return what the network's file is given for an image of such a size."""
    return {network.contract.tensor("image"): to_tensor(image, network.contract)}
