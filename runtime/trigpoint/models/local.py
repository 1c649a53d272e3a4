"""From an image to keypoints and local descriptors, in one pass of a network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.models.contract import FeaturesContract
from trigpoint.models.dense import sample_bilinear, select_keypoints
from trigpoint.models.inputs import normalize, resize, to_tensor
from trigpoint.models.session import Network, open_network
from trigpoint.models.sparse import read_lists

Array32 = NDArray[np.float32]
Outputs = dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Extraction:
    """What one pass gives, best score first."""

    keypoints: Array32  # (N, 2) px of the original image
    descriptors: Array32  # (N, D), L2-normalised
    scores: Array32  # (N,), falling
    global_descriptor: Array32 | None  # (G,), L2-normalised, where the network gives one


@dataclass(frozen=True, eq=False)
class FeatureNetwork:
    """A network that finds and describes keypoints."""

    network: Network[FeaturesContract]

    @classmethod
    def load(cls, path: Path, *, num_threads: int = 2) -> FeatureNetwork:
        """Load a network of kind "features"."""
        return cls(open_network(path, FeaturesContract, num_threads))

    @property
    def contract(self) -> FeaturesContract:
        """What it says of itself."""
        return self.network.contract

    @property
    def long_side_px(self) -> int:
        """How long a side of an image it sees at the most."""
        size = self._fixed_size()
        return max(size) if size else self.contract.long_side_px

    def extract(self, image: NDArray[np.uint8], max_keypoints: int = 1024) -> Extraction:
        """Extract at most `max_keypoints` features of a gray image (H, W)."""
        small = resize(image, *self._input_size(image.shape))
        outputs = self.network.run({"image": to_tensor(small, self.contract)})
        if self.contract.layout == "dense":
            points, descriptors, scores = self._read_maps(outputs, small.shape, max_keypoints)
        else:
            points, descriptors, scores = read_lists(
                self.network, outputs, small.shape, max_keypoints
            )
        zoom: Array32 = np.divide(image.shape[::-1], small.shape[::-1]).astype(np.float32)
        described = outputs.get("global")
        return Extraction(
            keypoints=(points + 0.5) * zoom - 0.5,
            descriptors=normalize(descriptors),
            scores=scores,
            global_descriptor=(
                None if described is None else normalize(described[0].astype(np.float32))
            ),
        )

    def _read_maps(
        self, outputs: Outputs, shape: tuple[int, ...], max_keypoints: int
    ) -> tuple[Array32, Array32, Array32]:
        """Read the maps of the dense layout, of an image of a shape (H, W)."""
        score, desc = outputs["score"][0, 0], outputs["desc"][0]
        if score.shape != shape:
            raise ModelError(
                f"the network {self.contract.name!r} gave scores of shape {score.shape} for an "
                f"image of shape {shape}; the contract is a score for each pixel"
            )
        points, scores = select_keypoints(score, max_keypoints, self.contract.min_score)
        # A cell's centre is the centre of the pixels it covers.
        scale: Array32 = np.divide(desc.shape[:0:-1], shape[::-1]).astype(np.float32)
        return points, sample_bilinear(desc, (points + 0.5) * scale - 0.5), scores

    def _input_size(self, shape: tuple[int, ...]) -> tuple[int, int]:
        """Height and width at which the network sees an image: multiples, axis by axis."""
        if size := self._fixed_size():
            return size
        zoom = min(1.0, self.contract.long_side_px / max(shape))
        step = self.contract.multiple_of
        height, width = (max(step, round(side * zoom / step) * step) for side in shape)
        return height, width

    def _fixed_size(self) -> tuple[int, int] | None:
        """Height and width of the input, where the file leaves no choice."""
        match self.network.declared("image"):
            case [_, _, int(height), int(width)]:
                return height, width
        return None
