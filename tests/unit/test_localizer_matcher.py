"""The pipeline on the rendered room with a network that matches."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Demo
from tests.unit import graphs
from trigpoint.database.reader import MapReader
from trigpoint.frame import Frame, Localized, describe
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.contract import MatcherContract
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import OnnxMatcher
from trigpoint_db.adapt import adapt_model
from trigpoint_db.demo import CAMERA


@pytest.fixture(scope="module")
def reader(demo: Demo, model: FeatureModel) -> Iterator[MapReader]:
    with MapReader.open(demo.map, model.identity) as opened:
        yield opened


@pytest.fixture(scope="module")
def frame(demo: Demo) -> Frame:
    return Frame(read_gray(demo.folder / "flight" / "000005.jpg"), CAMERA)


def localized(localizer: Localizer, frame: Frame) -> Localized:
    result = localizer.localize(frame)
    assert isinstance(result, Localized), describe(result)
    return result


def test_a_network_of_mutual_nearest_neighbours_gives_the_same_pose(
    model: FeatureModel, reader: MapReader, frame: Frame, tmp_path: Path
) -> None:
    dim = model.identity.descriptor_dim
    source = graphs.mutual_matcher(tmp_path / "plain.onnx", "(P, 2)", dim=dim)
    path = tmp_path / "matcher.onnx"
    adapt_model(source, path, {"kind": "matcher", "name": "mutual", "descriptor_dim": dim})
    ours = localized(Localizer(model, reader), frame)
    network = localized(
        Localizer(model, reader, matcher=OnnxMatcher.load(path, dim, num_threads=1)), frame
    )
    assert network.statistics.num_matcher_failures == 0
    # In floats where ours are integers: matches of nearly equal scores change places.
    assert abs(network.statistics.num_matches / ours.statistics.num_matches - 1) < 0.02
    centers = network.cam_from_world.center, ours.cam_from_world.center
    np.testing.assert_allclose(*centers, atol=2e-3)
    np.testing.assert_allclose(network.cam_from_world.R, ours.cam_from_world.R, atol=1e-3)


def test_where_the_network_fails_mutual_nearest_neighbours_do(
    model: FeatureModel, reader: MapReader, frame: Frame, tmp_path: Path
) -> None:
    dim = model.identity.descriptor_dim
    contract = MatcherContract(name="failing", descriptor_dim=dim)
    path = graphs.failing_matcher(tmp_path / "failing.onnx", dim, metadata=contract.to_json())
    ours = localized(Localizer(model, reader), frame)
    failing = localized(Localizer(model, reader, matcher=OnnxMatcher.load(path, dim)), frame)
    assert failing.statistics.num_matcher_failures == failing.statistics.num_anchors >= 6
    assert ours.statistics.num_matcher_failures == 0
    np.testing.assert_array_equal(failing.cam_from_world.t, ours.cam_from_world.t)
    np.testing.assert_array_equal(failing.covariance, ours.covariance)
