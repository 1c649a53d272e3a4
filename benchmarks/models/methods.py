"""What is compared: our networks, RootSIFT, EdgePoint2."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.models import edgepoint2
from benchmarks.models.rootsift import RootSift
from benchmarks.models.surveys import Survey
from trigpoint.errors import ConfigError
from trigpoint.frame import LocalFeatures
from trigpoint.models.features import PROFILES, FeatureModel, packaged_model
from trigpoint.models.matching import match_mutual

BASELINE = "EdgePoint2-E64"
NUM_KEYPOINTS = 1024
TURNED = "base"  # the profile that is also tried with four passes


class Extractor(Protocol):
    """What makes features of an image."""

    def extract(self, image: NDArray[np.uint8], max_keypoints: int = ...) -> LocalFeatures:
        """Extract features of a gray image (H, W), best score first."""
        ...


@dataclass(frozen=True)
class Method:
    """One row of the tables.

    Parameters
    ----------
    name : str
        The row's heading.
    path : Path, optional
        The ONNX file; none for RootSIFT.
    ours : bool
        Whether it is a network that `FeatureModel` loads.
    retrieval : Path, optional
        A network beside it that gives the global descriptor.
    variant : bool
        Whether it differs from another row only in precision or in the sub-pixel fit; the longest
        tables leave it out.
    subpixel : bool
        EdgePoint2's keypoints are refined.
    max_ratio : float, optional
        Lowe's ratio test between the nearest and the second nearest descriptor.
    turned : bool
        In the table of rotations, there is a row for it with four passes.
    """

    name: str
    path: Path | None = None
    ours: bool = False
    retrieval: Path | None = None
    variant: bool = False
    subpixel: bool = False
    max_ratio: float | None = None
    turned: bool = False

    def open(self) -> Extractor:
        """Load it, to run on one thread."""
        if self.path is None:
            return RootSift()
        if self.ours:
            return FeatureModel.load(self.path, retrieval=self.retrieval, num_threads=1)
        return edgepoint2.EdgePoint2(self.path, subpixel=self.subpixel)

    def match(self, a: LocalFeatures, b: LocalFeatures) -> NDArray[np.intp]:
        """Match mutual nearest neighbours: (M, 2), the most similar first."""
        matches, similarities = match_mutual(a.descriptors, b.descriptors)
        if self.max_ratio is None or len(b) < 2:
            return matches
        similarity = a.descriptors[matches[:, 0]] @ b.descriptors.T
        second = np.partition(similarity, -2, axis=1)[:, -2]
        nearest, next_nearest = (np.sqrt(np.maximum(2 - 2 * s, 0)) for s in (similarities, second))
        return matches[nearest < self.max_ratio * next_nearest]


class Features:
    """Features of the images of surveys, extracted when first asked for."""

    def __init__(self, method: Method) -> None:
        self.method = method
        self.extractor = method.open()
        self._of: dict[tuple[str, int], LocalFeatures] = {}

    def of(self, survey: Survey, index: int) -> LocalFeatures:
        """Return the features of one image."""
        key = survey.name, index
        if key not in self._of:
            self._of[key] = self.extractor.extract(survey.images[index], NUM_KEYPOINTS)
        return self._of[key]


def find_methods(
    fp32: Path | None,
    checkout: Path | None,
    models: Iterable[Path],
    retrieval: Path | None,
    scratch: Path,
) -> list[Method]:
    """List what there is to compare, each of which can be opened.

    Parameters
    ----------
    fp32 : Path, optional
        Folder of our networks' files in float32, `base.fp32.onnx`, and perhaps of what
        `trigpoint-db quantize` made of them, `base.int8.onnx`: an export has a global head of its
        own, so that only these two can be compared through the localizer.
    checkout : Path, optional
        Of EdgePoint2.
    models : iterable of Path
        Other networks that `FeatureModel` loads.
    retrieval : Path, optional
        The network beside these that gives the global descriptor.
    scratch : Path
        Folder for exported networks.
    """
    methods = [
        Method(f"{profile} INT8", packaged_model(profile), ours=True, turned=profile == TURNED)
        for profile in PROFILES
        if packaged_model(profile).is_file()
    ]
    if fp32 is not None:
        files = {profile: fp32 / f"{profile}.fp32.onnx" for profile in PROFILES}
        found = [profile for profile, path in files.items() if path.is_file()]
        if not found:
            raise ConfigError(f"{fp32} holds none of {', '.join(p.name for p in files.values())}")
        methods += [
            Method(f"{profile} fp32", files[profile], ours=True, variant=True) for profile in found
        ]
        quantized = {profile: fp32 / f"{profile}.int8.onnx" for profile in found}
        methods += [
            Method(f"{profile} fp32, made INT8", path, ours=True, variant=True)
            for profile, path in quantized.items()
            if path.is_file()
        ]
    methods += [Method(path.name, path, ours=True, retrieval=retrieval) for path in models]
    methods.append(Method("RootSIFT", max_ratio=0.8))
    if checkout is not None:
        methods += _edgepoint2(checkout.resolve(), scratch)
    names = [method.name for method in methods]
    for method in methods:
        if names.count(method.name) > 1:
            raise ConfigError(f"two networks are called {method.name}; rename one")
        method.open()
    return methods


def _edgepoint2(checkout: Path, scratch: Path) -> Iterator[Method]:
    for configuration in ("E64", "S32"):
        name, path = f"EdgePoint2-{configuration}", scratch / f"{configuration}.onnx"
        # In a process of its own: torch's threads would disturb the clock.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            pool.submit(edgepoint2.export, checkout, configuration, path).result()
        yield Method(name, path)
        yield Method(f"{name}, sub-pixel", path, variant=True, subpixel=True)
