"""The global descriptor from a network of its own, where the feature network gives none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trigpoint.models.contract import RetrievalContract
from trigpoint.models.inputs import normalize, resize, to_tensor
from trigpoint.models.session import Network, open_network


@dataclass(frozen=True, eq=False)
class RetrievalModel:
    """A network that describes an image by one vector."""

    network: Network[RetrievalContract]

    @classmethod
    def load(cls, path: Path, *, num_threads: int = 2) -> RetrievalModel:
        """Load a network of kind "retrieval"."""
        return cls(open_network(path, RetrievalContract, num_threads))

    @property
    def contract(self) -> RetrievalContract:
        """What it says of itself."""
        return self.network.contract

    def describe(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the global descriptor (G,), L2-normalised, of a gray image (H, W)."""
        small = resize(image, self.contract.height, self.contract.width)
        outputs = self.network.run({"image": to_tensor(small, self.contract)})
        return normalize(outputs["global"][0].astype(np.float32))
