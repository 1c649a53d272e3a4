"""From an image to keypoints, local descriptors and the global descriptor."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.frame import LocalFeatures, ModelIdentity
from trigpoint.models.local import FeatureNetwork
from trigpoint.models.retrieval import RetrievalModel
from trigpoint.models.session import hash_files

Profile = Literal["tiny", "base", "large"]
PROFILES: tuple[Profile, ...] = get_args(Profile)


def packaged_model(profile: Profile = "base") -> Path:
    """Return the path of a network in the box."""
    return Path(str(resources.files("trigpoint.models") / "weights" / f"{profile}.int8.onnx"))


def find_model(name: str | Path) -> Path:
    """Return the path of a network: a profile's in the box, or a file's."""
    for profile in PROFILES:
        if name == profile:
            return packaged_model(profile)
    path = Path(name)
    if not path.is_file():
        raise ModelError(f"no such model file: {path}; in the box: {', '.join(PROFILES)}")
    return path


@dataclass(frozen=True, eq=False)
class FeatureModel:
    """A feature network, with a retrieval network where it gives no global descriptor itself."""

    network: FeatureNetwork
    retrieval: RetrievalModel | None
    identity: ModelIdentity

    @classmethod
    def load(
        cls, name: str | Path = "base", *, retrieval: Path | None = None, num_threads: int = 2
    ) -> FeatureModel:
        """Load a network.

        Parameters
        ----------
        name : str or Path
            A profile in the box ("tiny", "base", "large"), or a file.
        retrieval : Path, optional
            A network for the global descriptor; needed where the other gives none.
        num_threads : int
            Of each network.
        """
        path = find_model(name)
        network = FeatureNetwork.load(path, num_threads=num_threads)
        contract = network.contract
        if retrieval is not None:
            describer = RetrievalModel.load(retrieval, num_threads=num_threads)
            label = f"{contract.name} + {describer.contract.name}"
            sha256, global_dim = hash_files(path, retrieval), describer.contract.global_dim
        elif contract.global_dim:
            describer, label = None, contract.name
            sha256, global_dim = hash_files(path), contract.global_dim
        else:
            raise ModelError(
                f"{path} gives no global descriptor; name a retrieval network beside it: "
                "`retrieval` in [model], or --retrieval (docs/models.md)"
            )
        identity = ModelIdentity(label, sha256, contract.descriptor_dim, global_dim)
        return cls(network, describer, identity)

    @property
    def long_side_px(self) -> int:
        """How long a side of an image the network sees at the most."""
        return self.network.long_side_px

    def extract(self, image: NDArray[np.uint8], max_keypoints: int = 1024) -> LocalFeatures:
        """Extract at most `max_keypoints` features of a gray image (H, W), best score first."""
        found = self.network.extract(image, max_keypoints)
        described = found.global_descriptor
        if self.retrieval is not None:
            described = self.retrieval.describe(image)
        assert described is not None  # a network that gives none is not loaded without another
        return LocalFeatures(found.keypoints, found.descriptors, found.scores, described)
