"""hloc (https://github.com/cvg/Hierarchical-Localization, Apache-2.0), run from its checkout.

Its map is triangulated by COLMAP from the same keypoints and matches that our localizer has, with
the known poses; a query is solved by its `pose_from_cluster`. Needs pycolmap (extra `colmap`) and
h5py.
"""

from __future__ import annotations

import importlib
import itertools
import logging
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ConfigError
from trigpoint.frame import Anchor, LocalFeatures
from trigpoint.models.matching import Matchable, MutualNearestNeighbors
from trigpoint.rigid import Rigid3
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import write_model

MAX_ERROR_PX = 12.0  # the default of hloc's localize_sfm
NUM_NEIGHBOURS = 20  # of each anchor, those with the most matches: the map is made of these

Matches = Mapping[tuple[str, str], NDArray[np.intp]]


class Hloc:
    """hloc's modules, and one map.

    Parameters
    ----------
    checkout : Path
    scratch : Path
        Folder for its files.
    anchors : sequence of Anchor
        The map.
    matches : mapping of (name, name) to (M, 2) int
        Of the pairs of anchors that are triangulated.
    """

    def __init__(
        self, checkout: Path, scratch: Path, anchors: Sequence[Anchor], matches: Matches
    ) -> None:
        self._triangulation, self._localize_sfm, self._pycolmap = _import(checkout)
        self._scratch = scratch
        model = scratch / "model"
        write_model(model, [PosedImage(a.name, a.camera, a.cam_from_world) for a in anchors])
        features, pairs = scratch / "features.h5", scratch / "pairs.txt"
        write_keypoints(features, {anchor.name: anchor.keypoints for anchor in anchors})
        write_matches(scratch / "matches.h5", matches)
        pairs.write_text("".join(f"{a} {b}\n" for a, b in matches))
        reconstruction = self._triangulation.main(
            scratch / "sfm", model, scratch, pairs, features, scratch / "matches.h5"
        )
        self._ids = {image.name: i for i, image in reconstruction.images.items()}
        config = {"estimation": {"ransac": {"max_error": MAX_ERROR_PX}}}
        self._localizer = self._localize_sfm.QueryLocalizer(reconstruction, config)

    @property
    def num_model_bytes(self) -> int:
        """How large the reconstruction is as COLMAP keeps it."""
        return sum(path.stat().st_size for path in (self._scratch / "sfm").glob("*.bin"))

    def localize(
        self, name: str, camera: Any, anchors: Iterable[str], features: Path, matches: Path
    ) -> Rigid3 | None:
        """Solve a query from the files that hold its keypoints and matches; None if it fails."""
        found, _ = self._localize_sfm.pose_from_cluster(
            self._localizer, name, camera, [self._ids[a] for a in anchors], features, matches
        )
        if found is None:
            return None
        pose = found["cam_from_world"]
        return Rigid3(pose.rotation.matrix(), np.array(pose.translation))

    def camera(self, text: str) -> Any:
        """Make pycolmap's camera of a line of hloc's list of queries."""
        model, width, height, *params = text.split()
        return self._pycolmap.Camera(
            model=model, width=int(width), height=int(height), params=[float(p) for p in params]
        )


def write_keypoints(path: Path, keypoints: Mapping[str, NDArray[np.float32]]) -> None:
    """Write keypoints (N, 2) as hloc reads them."""
    import h5py

    with h5py.File(path, "w", libver="latest") as file:
        for name, points in keypoints.items():
            file.create_group(name).create_dataset("keypoints", data=points.astype(np.float64))


def write_matches(path: Path, matches: Matches) -> None:
    """Write matches (M, 2) as hloc reads them: for each keypoint of the first its match, or -1."""
    import h5py

    with h5py.File(path, "w", libver="latest") as file:
        for (a, b), pairs in matches.items():
            matched = np.full(pairs[:, 0].max(initial=-1) + 1, -1, np.int32)
            matched[pairs[:, 0]] = pairs[:, 1]
            group = file.create_group(f"{a.replace('/', '-')}/{b.replace('/', '-')}")
            group.create_dataset("matches0", data=matched)
            group.create_dataset("matching_scores0", data=(matched >= 0).astype(np.float16))


def write_features(path: Path, features: Mapping[str, LocalFeatures]) -> None:
    """Write local and global features as hloc keeps them, in half precision."""
    import h5py

    with h5py.File(path, "w", libver="latest") as file:
        for name, image in features.items():
            group = file.create_group(name)
            for key, values in (
                ("keypoints", image.keypoints),
                ("descriptors", image.descriptors.T),
                ("scores", image.scores),
                ("global_descriptor", image.global_descriptor),
            ):
                group.create_dataset(key, data=values.astype(np.float16))


def match_map(anchors: Mapping[str, Anchor]) -> dict[tuple[str, str], NDArray[np.intp]]:
    """Match all anchors, and keep each one's matches with its best neighbours."""
    names = list(anchors)
    matcher = MutualNearestNeighbors()
    matchable = {name: Matchable.of(anchor, anchor.camera) for name, anchor in anchors.items()}
    matches = {
        (a, b): matcher.match(matchable[a], matchable[b])[0]
        for a, b in itertools.combinations(names, 2)
    }
    kept = set()
    for name in names:
        own = [pair for pair in matches if name in pair]
        kept.update(sorted(own, key=lambda pair: -len(matches[pair]))[:NUM_NEIGHBOURS])
    return {pair: matches[pair] for pair in matches if pair in kept}


def match_query(
    query: Matchable, anchors: Mapping[str, Anchor], retrieved: Sequence[str]
) -> dict[str, NDArray[np.intp]]:
    """Match a query with the anchors retrieved for it."""
    matcher = MutualNearestNeighbors()
    return {
        name: matcher.match(query, Matchable.of(anchors[name], anchors[name].camera))[0]
        for name in retrieved
    }


def _import(checkout: Path) -> tuple[Any, Any, Any]:
    os.environ["TQDM_DISABLE"] = "1"  # before hloc imports it
    sys.path.insert(0, str(checkout))
    try:
        triangulation: Any = importlib.import_module("hloc.triangulation")
        localize_sfm = importlib.import_module("hloc.localize_sfm")
        pycolmap = importlib.import_module("pycolmap")
    except ImportError as error:
        raise ConfigError(
            f"{checkout} is not a checkout of hloc, or what it needs is not installed "
            f"({error}); install it with: pip install 'trigpoint[colmap]' h5py tqdm packaging"
        ) from error
    finally:
        sys.path.remove(str(checkout))
    logging.getLogger("hloc").setLevel(logging.ERROR)
    pycolmap.logging.minloglevel = 2
    # pycolmap 4 ignores the matches of a geometry that does not say what it is.
    geometry = partial(
        pycolmap.TwoViewGeometry, config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    )
    triangulation.pycolmap = SimpleNamespace(**vars(pycolmap) | {"TwoViewGeometry": geometry})
    return triangulation, localize_sfm, pycolmap
