"""Networks in the layouts that others export, adapted and used end to end."""

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from tests.unit import graphs
from tests.unit.graphs import DIM, NUM_GLOBAL
from tests.unit.scenes import generator
from trigpoint.errors import ConfigError, ModelError
from trigpoint.models.features import FeatureModel
from trigpoint.models.local import FeatureNetwork
from trigpoint_db.adapt import adapt_model
from trigpoint_db.cli import app

SPARSE: dict[str, Any] = {
    "kind": "features", "name": "foreign", "layout": "sparse", "descriptor_dim": DIM,
    "min_score": 0.01,
}  # fmt: skip
DENSE: dict[str, Any] = {**SPARSE, "layout": "dense", "multiple_of": 32}
RETRIEVAL: dict[str, Any] = {
    "kind": "retrieval", "name": "places", "global_dim": NUM_GLOBAL, "height": 320, "width": 320,
    "names": {"image": "img", "global": "des"},
}  # fmt: skip


def spots(
    height: int = 480, width: int = 640, zoom: float = 1.0
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Bright spots on gray at known places, x and y."""
    rng = generator("spots")
    grid = np.stack(np.meshgrid(np.arange(40, 620, 40), np.arange(40, 460, 40)), axis=-1)
    places = grid.reshape(-1, 2) + rng.integers(-8, 9, (grid.size // 2, 2))
    centers = (places + 0.5) * zoom - 0.5
    v, u = np.mgrid[:height, :width]
    image = np.full((height, width), 60.0)
    for (x, y), peak in zip(centers, rng.uniform(80, 180, len(centers)), strict=True):
        image += peak * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * (2 * zoom) ** 2))
    return np.clip(image, 0, 255).astype(np.uint8), np.asarray(centers, np.float64)


def worst_distance(points: NDArray[np.float32], to: NDArray[np.float64]) -> float:
    """How far a place of `to` is from the nearest point, at the most."""
    return float(np.linalg.norm(to[:, None] - points[None], axis=2).min(axis=1).max())


@pytest.fixture
def retrieval(tmp_path: Path) -> Path:
    source, out = tmp_path / "eigenplaces.onnx", tmp_path / "places.onnx"
    adapt_model(graphs.eigenplaces_like(source), out, RETRIEVAL)
    return out


def make(layout: str, folder: Path) -> Path:
    """Adapt a network of a foreign layout."""
    source, out = folder / f"{layout}_like.onnx", folder / f"{layout}.onnx"
    if layout == "superpoint":
        fields = {**SPARSE, "multiple_of": 8}
        graphs.superpoint_like(source)
    elif layout == "aliked":
        fields = {**SPARSE, "channels": 3, "keypoints": "normalized"}
        graphs.aliked_like(source, 480, 640)
    elif layout == "xfeat":
        names = {"image": "images", "keypoints": "kpts", "descriptors": "desc"}
        fields = {**SPARSE, "channels": 3, "multiple_of": 32, "names": names}
        graphs.xfeat_like(source)
    else:
        fields = {**DENSE, "min_score": 0.2}
        graphs.edgepoint2_like(source)
    adapt_model(source, out, fields)
    return out


@pytest.mark.parametrize("layout", ["superpoint", "aliked", "xfeat", "edgepoint2"])
@pytest.mark.parametrize("zoom", [1, 2])
def test_a_foreign_network_finds_the_spots(
    tmp_path: Path, retrieval: Path, layout: str, zoom: int
) -> None:
    """In px of the image itself, also where the network sees it at half the size."""
    model = FeatureModel.load(make(layout, tmp_path), retrieval=retrieval, num_threads=1)
    image, centers = spots(480 * zoom, 640 * zoom, zoom)
    features = model.extract(image, 250)
    assert worst_distance(features.keypoints, centers) < 0.75 * zoom
    assert (np.diff(features.scores) <= 0).all()
    assert features.descriptors.shape == (len(features), DIM)
    assert features.descriptors.dtype == features.keypoints.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    assert features.global_descriptor.shape == (NUM_GLOBAL,)
    assert abs(np.linalg.norm(features.global_descriptor) - 1) < 1e-5
    assert model.identity.name == "foreign + places"
    assert (model.identity.descriptor_dim, model.identity.global_dim) == (DIM, NUM_GLOBAL)


def test_all_sparse_layouts_say_the_same(tmp_path: Path) -> None:
    """They are the same network in different clothes."""
    image, _ = spots()
    first, *others = (
        FeatureNetwork.load(make(layout, tmp_path)).extract(image, 150)
        for layout in ("superpoint", "aliked", "xfeat")
    )
    for other in others:
        np.testing.assert_allclose(other.keypoints, first.keypoints, atol=1e-3)
        np.testing.assert_allclose(other.descriptors, first.descriptors, atol=1e-3)
        assert other.global_descriptor is None


def test_as_many_keypoints_as_numbers_are_told_apart_by_what_is_declared(tmp_path: Path) -> None:
    """Descriptors (1, D, N) where N is D."""
    graph = graphs.Graph(image=[1, 1, "height", "width"])
    table = np.arange(16, dtype=np.float32).reshape(1, 4, 4)
    outputs: dict[str, tuple[str, graphs.Shape]] = {
        "keypoints": (graph.hidden(np.full((4, 2), 10)), ["num", 2]),
        "scores": (graph.hidden([4, 3, 2, 1]), ["num"]),
        "descriptors": (graph.hidden(table), [1, 4, "num"]),
    }
    graph.save(tmp_path / "square.onnx", outputs)
    fields = {**SPARSE, "descriptor_dim": 4}
    adapt_model(tmp_path / "square.onnx", tmp_path / "out.onnx", fields)
    found = FeatureNetwork.load(tmp_path / "out.onnx").extract(spots()[0])
    column = table[0, :, 1]
    np.testing.assert_allclose(found.descriptors[1], column / np.linalg.norm(column), atol=1e-6)


def test_retrieval_sees_what_the_image_shows(tmp_path: Path, retrieval: Path) -> None:
    model = FeatureModel.load(make("edgepoint2", tmp_path), retrieval=retrieval)
    image, _ = spots()
    brighter = np.asarray(cv2.convertScaleAbs(image, alpha=1.02), np.uint8)
    noise = generator("other").integers(0, 255, image.shape).astype(np.uint8)
    same, near, far = (model.extract(i).global_descriptor for i in (image, brighter, noise))
    assert same @ near > same @ far


def test_without_a_global_descriptor_a_retrieval_network_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"gives no global descriptor; name a retrieval network"):
        FeatureModel.load(make("superpoint", tmp_path))


def test_networks_of_one_kind_do_not_stand_for_another(tmp_path: Path, retrieval: Path) -> None:
    with pytest.raises(ModelError, match="of kind 'retrieval', where 'features' is needed"):
        FeatureModel.load(retrieval)
    features = make("superpoint", tmp_path)
    with pytest.raises(ModelError, match="of kind 'features', where 'retrieval' is needed"):
        FeatureModel.load(features, retrieval=features)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"descriptor_dim": 32}, r"gave 'descriptors' of shape \(1, 300, 16\); by its contract it"),
        ({"layout": "dense"}, r"no output 'score', but descriptors, keypoints, scores"),
        ({"names": {"keypoints": "kpts"}}, "no output 'kpts', but descriptors, keypoints, scores"),
        ({"names": {"points": "kpts"}}, "names 'points', which is none of image, keypoints"),
        ({"min_score": 1e6}, "found no keypoint in a test image"),
        ({"channels": 3}, r"'image' is of shape \(1, 1, height, width\)"),
        ({"normalization": "imagenet"}, "'imagenet' is of 3 channels"),
        ({"height": 320}, "unknown field 'height'"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_said_in_one_line_and_nothing_is_written(
    tmp_path: Path, fields: dict[str, Any], message: str
) -> None:
    source = graphs.superpoint_like(tmp_path / "superpoint.onnx")
    with pytest.raises(ModelError, match=message) as caught:
        adapt_model(source, tmp_path / "out.onnx", {**SPARSE, **fields})
    assert "\n" not in str(caught.value)
    assert "partial" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["superpoint.onnx"]


def test_files_that_are_no_networks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such model file"):
        adapt_model(tmp_path / "none.onnx", tmp_path / "out.onnx", SPARSE)
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(ModelError, match="is not an ONNX file"):
        adapt_model(tmp_path / "text.onnx", tmp_path / "out.onnx", SPARSE)
    with pytest.raises(ConfigError, match="there is no folder"):
        adapt_model(tmp_path / "text.onnx", tmp_path / "none" / "out.onnx", SPARSE)


def test_without_onnx_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = graphs.superpoint_like(tmp_path / "superpoint.onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ConfigError, match=r"pip install 'trigpoint\[quantize\]'"):
        adapt_model(source, tmp_path / "out.onnx", SPARSE)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["adapt", *arguments])


def test_the_command_adapts(tmp_path: Path) -> None:
    source, out = graphs.xfeat_like(tmp_path / "xfeat.onnx"), tmp_path / "out.onnx"
    result = run(
        str(source), str(out), "--json", "--kind", "features", "--layout", "sparse",
        "--descriptor-dim", str(DIM), "--channels", "3", "--min-score", "0.01",
        "--rename", "image=images", "--rename", "keypoints=kpts", "--rename", "descriptors=desc",
    )  # fmt: skip
    assert result.exit_code == 0, result.exception
    report = json.loads(result.stdout)
    assert report["contract"] == FeatureNetwork.load(out).contract.model_dump()
    assert report["contract"]["name"] == "xfeat"
    assert report["contract"]["names"]["keypoints"] == "kpts"
    assert report["found"].endswith("keypoints")


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    source, out = str(graphs.xfeat_like(tmp_path / "xfeat.onnx")), str(tmp_path / "out.onnx")
    assert "--rename wants TENSOR=NAME" in str(run(source, out, "--kind", "features", "--rename",
                                                   "image").exception)  # fmt: skip
    assert "needs a 'kind'" in str(run(source, out, "--kind", "detector").exception)
    assert "lacks 'descriptor_dim'" in str(run(source, out, "--kind", "features").exception)
    message = str(run(source, source, "--kind", "matcher", "--descriptor-dim", "8").exception)
    assert "it is an input; name another file" in message
