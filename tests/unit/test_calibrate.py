"""How well the poses of a map agree, found out from the map alone."""

from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Demo
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.frame import PoseNoise
from trigpoint.geometry.pose_refinement import perturb
from trigpoint.models.features import FeatureModel
from trigpoint_db.calibrate import MIN_TRIALS, calibrate_map


def copy_with_drift(demo: Demo, model: FeatureModel, out: Path, share: float) -> None:
    """Bend the survey smoothly: neighbours are off by about a share of their distance."""
    with MapReader.open(demo.map) as reader, MapWriter.create(out, model.identity) as writer:
        for index in range(len(reader)):
            anchor = reader.anchor(index)
            error = np.zeros(6)
            error[:3] = share * np.sqrt(2) * np.sin(anchor.cam_from_world.center[[1, 2, 0]])
            moved = perturb(anchor.cam_from_world, error)
            writer.add(anchor.name, anchor.camera, moved, reader.features(index))


def test_the_demos_map_is_exact_and_a_bent_one_is_not(
    demo: Demo, model: FeatureModel, tmp_path: Path
) -> None:
    with MapReader.open(demo.map) as reader:
        exact = reader.pose_noise  # as the demo was calibrated
    assert exact is not None
    assert exact.std(np.ones(1))[0, 0] <= 0.003
    assert exact.std(np.ones(1))[0, 3] <= 4e-4
    copy_with_drift(demo, model, tmp_path / "bent.tpmap", 0.02)
    bent = calibrate_map(tmp_path / "bent.tpmap", model)
    assert bent is not None
    assert 0.004 <= bent.std(np.ones(1))[0, 0] <= 0.064
    with MapReader.open(tmp_path / "bent.tpmap") as reader:
        assert reader.pose_noise == bent
        assert reader.verify() == []


def test_a_map_of_few_images_says_nothing(demo: Demo, model: FeatureModel, tmp_path: Path) -> None:
    path = tmp_path / "few.tpmap"
    with MapReader.open(demo.map) as reader, MapWriter.create(path, model.identity) as writer:
        for index in range(3):
            anchor = reader.anchor(index)
            writer.add(anchor.name, anchor.camera, anchor.cam_from_world, reader.features(index))
    assert MIN_TRIALS > 3
    assert calibrate_map(path, model) is None
    with MapReader.open(path) as reader:
        assert reader.pose_noise is None


def test_an_empty_map_says_nothing(model: FeatureModel, tmp_path: Path) -> None:
    MapWriter.create(tmp_path / "empty.tpmap", model.identity).close()
    assert calibrate_map(tmp_path / "empty.tpmap", model) is None


@pytest.mark.parametrize("noise", [PoseNoise(0.002, 0.01, 0.001, 0.003), None])
def test_the_noise_stays_with_the_map(
    model: FeatureModel, tmp_path: Path, noise: PoseNoise | None
) -> None:
    path = tmp_path / "map.tpmap"
    with MapWriter.create(path, model.identity) as writer:
        writer.set_pose_noise(noise)
    with MapWriter.open(path, model.identity):
        pass
    with MapReader.open(path) as reader:
        assert reader.pose_noise == noise
