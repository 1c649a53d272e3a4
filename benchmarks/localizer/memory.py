"""Memory over many localizations in a map of ten thousand images.

The map holds a rendered room and, for the rest, images with random features, all of 1024 keypoints.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import threadpoolctl

from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import Frame, LocalFeatures, Localized
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpoint_db.demo import CAMERA
from trigpoint_db.experiments.tables import markdown
from trigpoint_db.synthetic import flight_poses, make_room, render, survey_poses

NUM_SURVEY, NUM_FLIGHT, NUM_KEYPOINTS = 60, 20, 1024


def make_map(path: Path, num_images: int) -> list[Frame]:
    """Write the map; return frames of the room."""
    network, rng = FeatureModel.load(), np.random.default_rng(0)
    world = make_room(0)
    survey, flight = survey_poses(world, NUM_SURVEY), flight_poses(world, NUM_FLIGHT)
    with MapWriter.create(path, network.identity) as writer:
        for i in range(NUM_SURVEY):
            image = render(world, CAMERA, survey[i], seed=i)
            writer.add(f"room {i}", CAMERA, survey[i], network.extract(image, NUM_KEYPOINTS))
        for i in range(num_images - NUM_SURVEY):
            pose = Rigid3.from_center(np.eye(3), rng.normal(size=3) * 1000)
            writer.add(f"elsewhere {i}", CAMERA, pose, _random_features(network, rng))
    return [
        Frame(render(world, CAMERA, flight[i], seed=1000 + i), CAMERA) for i in range(NUM_FLIGHT)
    ]


def _random_features(network: FeatureModel, rng: np.random.Generator) -> LocalFeatures:
    dims = network.identity.descriptor_dim, network.identity.global_dim
    keypoints = rng.uniform((0, 0), (639, 479), (NUM_KEYPOINTS, 2)).astype(np.float32)
    descriptors = rng.normal(size=(NUM_KEYPOINTS, dims[0])).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    described = rng.normal(size=dims[1]).astype(np.float32)
    scores = np.linspace(1, 0, NUM_KEYPOINTS, dtype=np.float32)
    return LocalFeatures(keypoints, descriptors, scores, described / np.linalg.norm(described))


def resident_mb() -> dict[str, float]:
    """Read what is resident from the kernel (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    found = dict(line.split(":", 1) for line in lines if line.startswith("Rss"))
    return {name: int(found[name].split()[0]) / 1024 for name in ("RssAnon", "RssFile")}


def report(num_images: int = 10_000, num_frames: int = 10_000) -> str:
    """Tabulate what is resident, in MB, as the frames go by."""
    threadpoolctl.threadpool_limits(1, user_api="blas")
    network = FeatureModel.load()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "map.tpmap"
        # In a process of its own, which takes its memory with it.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            frames = pool.submit(make_map, path, num_images).result()
        with MapReader.open(path, network.identity) as reader:
            localizer, num_localized = Localizer(network, reader), 0
            for i in range(num_frames + 1):
                if i in (0, 100) or (i > 0 and i % max(1, num_frames // 10) == 0):
                    rows.append([f"{i}", *(f"{value:.0f}" for value in resident_mb().values())])
                result = localizer.localize(frames[i % len(frames)])
                num_localized += isinstance(result, Localized)
    table = markdown(["frames", "own", "the map's pages and libraries"], rows, num_words=0)
    return f"{table}\n\n{num_localized} of {num_frames + 1} frames were localized."
