from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

from tests.unit.scenes import generator
from trigpoint.errors import ModelError
from trigpoint.models.contract import METADATA_KEY, FeaturesContract
from trigpoint.models.dense import sample_bilinear, select_keypoints
from trigpoint.models.features import (
    PROFILES,
    FeatureModel,
    Profile,
    find_model,
    packaged_model,
)
from trigpoint.models.inputs import to_tensor


def checkers(height: int = 240, width: int = 320, key: str = "checkers") -> NDArray[np.uint8]:
    """Random squares, slightly blurred: many corners."""
    squares = generator(key).integers(30, 220, (height // 16, width // 16)).astype(np.uint8)
    image = cv2.resize(squares, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8)


@pytest.fixture(scope="module")
def model() -> FeatureModel:
    return FeatureModel.load(num_threads=1)


def peak(
    x: float, y: float, height: float, shape: tuple[int, int] = (40, 50)
) -> NDArray[np.float32]:
    v, u = np.mgrid[: shape[0], : shape[1]]
    return np.asarray(height - 0.1 * ((u - x) ** 2 + (v - y) ** 2), np.float32)


def test_a_parabola_is_found_to_a_hundredth_of_a_pixel() -> None:
    points, scores = select_keypoints(peak(20.3, 15.8, 5.0), 10, 0.0)
    np.testing.assert_allclose(points, [[20.3, 15.8]], atol=0.01)
    assert len(scores) == 1


def test_keypoints_come_best_first_and_no_more_than_asked_for() -> None:
    score = np.maximum(peak(10, 10, 3.0), np.maximum(peak(30, 10, 5.0), peak(20, 30, 4.0)))
    points, scores = select_keypoints(score, 2, 0.0)
    np.testing.assert_allclose(points, [[30, 10], [20, 30]], atol=0.01)
    assert scores[0] > scores[1]


def test_weak_peaks_and_peaks_at_the_border_are_no_keypoints() -> None:
    score = np.maximum(peak(25, 20, -1.0), peak(2, 20, 5.0))
    points, _ = select_keypoints(score, 10, 0.0)
    assert len(points) == 0


def test_a_plateau_is_no_keypoint() -> None:
    points, _ = select_keypoints(np.full((40, 50), 3.0, np.float32), 10, 0.0)
    assert len(points) == 0


def test_bilinear_sampling_reproduces_a_linear_map() -> None:
    v, u = np.mgrid[:6, :8].astype(np.float32)
    values = np.stack([u, v, 2 * u - v])
    points = generator("bilinear").uniform([0, 0], [7, 5], (50, 2)).astype(np.float32)
    expected = np.c_[points, 2 * points[:, 0] - points[:, 1]]
    np.testing.assert_allclose(sample_bilinear(values, points), expected, atol=1e-5)


def test_bilinear_sampling_is_clamped_at_the_edge() -> None:
    values = np.arange(12, dtype=np.float32).reshape(1, 3, 4)
    points = np.array([[-1, -1], [9, 9], [3, 0.5], [1.5, 2]], np.float32)
    np.testing.assert_allclose(sample_bilinear(values, points)[:, 0], [0, 11, 5, 9.5])
    one_cell = sample_bilinear(values[:, :1, :1], points)
    np.testing.assert_allclose(one_cell, 0)


def test_features_keep_their_promises(model: FeatureModel) -> None:
    image = checkers()
    features = model.extract(image, 200)
    assert 100 <= len(features) <= 200
    assert (np.diff(features.scores) <= 0).all()
    assert features.keypoints.dtype == features.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    assert abs(np.linalg.norm(features.global_descriptor) - 1) < 1e-5
    assert features.global_descriptor.shape == (model.identity.global_dim,)
    assert features.descriptors.shape[1] == model.identity.descriptor_dim
    assert (features.keypoints >= -0.5).all()
    assert (features.keypoints <= np.array([319.5, 239.5])).all()


def test_features_are_the_same_every_time(model: FeatureModel) -> None:
    first, second = model.extract(checkers()), model.extract(checkers())
    np.testing.assert_array_equal(first.keypoints, second.keypoints)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)


def test_keypoints_move_with_the_image(model: FeatureModel) -> None:
    """Shifting by the network's stride shifts the keypoints by as much."""
    wide = checkers(width=384)
    left, right = wide[:, :320], wide[:, 32:352]
    a, b = model.extract(left, 300).keypoints, model.extract(right, 300).keypoints
    inside = a[(a[:, 0] > 80) & (a[:, 0] < 300)]
    distance = np.linalg.norm((inside - [32, 0])[:, None] - b[None], axis=2).min(axis=1)
    assert (distance < 0.5).mean() > 0.8


def test_keypoints_of_a_larger_image_are_given_in_its_own_pixels(model: FeatureModel) -> None:
    """Scaled up twice, so that the network sees what it saw before."""
    small = checkers(480, 640)
    large = cv2.resize(small, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    a = model.extract(small, 300).keypoints
    b = model.extract(np.asarray(large, np.uint8), 300).keypoints
    expected = (a + 0.5) * 2 - 0.5
    distance = np.linalg.norm(expected[:, None] - b[None], axis=2).min(axis=1)
    assert (distance < 1.0).mean() > 0.8


@pytest.mark.parametrize("shape", [(100, 37), (31, 500), (1, 1), (1080, 1920)])
def test_any_image_size_works(model: FeatureModel, shape: tuple[int, int]) -> None:
    image = generator("size").integers(0, 255, shape).astype(np.uint8)
    features = model.extract(image, 50)
    assert np.isfinite(features.global_descriptor).all()
    assert (features.keypoints <= np.array(shape[::-1]) - 0.5).all()


def test_a_blank_image_has_no_features(model: FeatureModel) -> None:
    assert len(model.extract(np.full((240, 320), 128, np.uint8))) == 0


def test_another_network_is_a_file_away(model: FeatureModel, tmp_path: Path) -> None:
    network = onnx.load(packaged_model())
    contract = model.network.contract.model_copy(update={"name": "other", "normalization": "unit"})
    del network.metadata_props[:]
    onnx.helper.set_model_props(network, {METADATA_KEY: contract.to_json()})
    onnx.save(network, tmp_path / "other.onnx")
    other = FeatureModel.load(tmp_path / "other.onnx", num_threads=1)
    assert other.identity.name == "other"
    assert other.identity.sha256 != model.identity.sha256
    assert len(other.extract(checkers(), 100)) > 0


def test_the_base_profile_is_the_default(model: FeatureModel) -> None:
    assert find_model("base") == packaged_model() == packaged_model("base")
    assert model.identity == FeatureModel.load("base", num_threads=1).identity
    assert len({find_model(profile) for profile in PROFILES}) == len(PROFILES)


def test_files_that_are_no_networks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"no such model file: .* in the box: tiny, base, large"):
        FeatureModel.load(tmp_path / "missing.onnx")
    with pytest.raises(ModelError, match="no such model file: big; in the box"):
        FeatureModel.load("big")
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(ModelError, match="not a network that onnxruntime can load"):
        FeatureModel.load(tmp_path / "text.onnx")
    with pytest.raises(ModelError, match="no such model file"):
        FeatureModel.load(retrieval=tmp_path / "missing.onnx")


@pytest.mark.parametrize("normalization", ["standardize", "unit", "raw", "imagenet"])
def test_a_tensor_is_normalised_as_the_contract_says(normalization: str) -> None:
    image = checkers()
    contract = FeaturesContract(
        name="a",
        descriptor_dim=1,
        channels=3,
        normalization=normalization,  # type: ignore[arg-type]
    )
    tensor = to_tensor(image, contract)
    assert tensor.shape == (1, 3, *image.shape)
    assert tensor.dtype == np.float32
    x = image.astype(np.float64)
    expected = {
        "standardize": [np.clip((x - x.mean()) / max(x.std(), 4), -4, 4)] * 3,
        "unit": [x / 255] * 3,
        "raw": [x] * 3,
        "imagenet": [
            (x / 255 - mean) / std for mean, std in ((0.485, 0.229), (0.456, 0.224), (0.406, 0.225))
        ],
    }[normalization]
    np.testing.assert_allclose(tensor[0], expected, atol=1e-4)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_profile_has_its_card_and_computes_the_same_each_time(profile: Profile) -> None:
    path = packaged_model(profile)
    assert path.with_name(f"{profile}.md").is_file()
    texture = np.kron(generator("again").integers(0, 256, (40, 60)), np.ones((8, 8)))
    image = np.asarray(cv2.GaussianBlur(texture.astype(np.uint8), (0, 0), 2), np.uint8)
    one, two = (FeatureModel.load(profile, num_threads=n).extract(image) for n in (1, 2))
    assert len(one) > 100
    for name, values in vars(one).items():
        np.testing.assert_array_equal(values, getattr(two, name))


def test_the_box_is_small() -> None:
    assert sum(packaged_model(profile).stat().st_size for profile in PROFILES) < 8e6
