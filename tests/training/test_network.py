from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from training.export import Exported, export_onnx, fold_sums
from training.losses import score_loss
from training.network import PROFILES, Network, grow
from training.retrieval import GLOBAL_DIM, GlobalHead, learn_whitening


def network(profile: str, seed: int) -> Network:
    """A network in evaluation whose norms have seen something."""
    torch.manual_seed(seed)
    made = Network(PROFILES[profile])
    with torch.no_grad():
        for name, values in made.named_parameters():
            if "norm" in name or name.endswith((".1.weight", ".1.bias", ".0.weight")):
                values += 0.2 * torch.rand_like(values)
        made.train()
        for _ in range(3):
            made(torch.randn(2, 1, 64, 64))
    return made.eval()


@pytest.mark.parametrize("profile", PROFILES)
def test_the_outputs_have_the_shapes_of_the_contract(profile: str) -> None:
    with torch.no_grad():
        score, descriptors = network(profile, 0)(torch.randn(2, 1, 64, 96))
    stride = PROFILES[profile].descriptor_stride
    assert score.shape == (2, 1, 64, 96)
    assert descriptors.shape == (2, 64, 64 // stride, 96 // stride)


def test_a_grown_network_does_what_the_smaller_one_did() -> None:
    small, large = network("base", 0), Network(PROFILES["large"])
    grow(large, small.state_dict())
    image = torch.randn(1, 1, 64, 96)
    with torch.no_grad():
        for ours, theirs in zip(large.eval()(image), small(image), strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-2, rtol=1e-2)
    assert not torch.equal(next(large.parameters())[-1], torch.zeros(1, 4, 4))  # new ones can learn


def test_folding_changes_nothing() -> None:
    made, image = network("tiny", 1), torch.randn(1, 1, 64, 64)
    with torch.no_grad():
        before = made(image)
        fold_sums(made)
        for ours, theirs in zip(made(image), before, strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-2, rtol=1e-2)


def test_the_exported_graph_computes_what_torch_does(tmp_path: Path) -> None:
    ort = pytest.importorskip("onnxruntime")
    made = network("base", 2)
    head = GlobalHead(made)
    with torch.no_grad():
        head.words.normal_()
    whole = Exported(made, head)
    export_onnx(whole, tmp_path / "n.onnx")
    session = ort.InferenceSession(tmp_path / "n.onnx")
    for size in ((64, 64), (96, 160)):
        image = torch.randn(1, 1, *size)
        with torch.no_grad():
            expected = whole(image)
        for ours, theirs in zip(session.run(None, {"image": image.numpy()}), expected, strict=True):
            np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-2, rtol=1e-2)


def test_the_score_loss_is_least_at_the_target() -> None:
    heat = torch.rand(1, 1, 16, 16) * 0.98 + 0.01
    logits = heat.logit().requires_grad_()
    score_loss(logits, heat).backward()
    assert logits.grad.abs().max() < 1e-4
    assert score_loss(logits + 0.5, heat) > score_loss(logits, heat)


def test_whitening_brings_views_of_one_place_together() -> None:
    rng = np.random.default_rng(0)
    places = np.repeat(np.arange(300), 3)
    nuisance = rng.standard_normal((5, 300)) * 3  # directions in which views of a place differ
    vectors = rng.standard_normal((300, 300))[places]
    vectors += rng.standard_normal((900, 5)) @ nuisance + 0.1 * rng.standard_normal((900, 300))

    def recall(x: np.ndarray) -> float:
        x = x / np.linalg.norm(x, axis=1, keepdims=True)
        similarity = x @ x.T
        np.fill_diagonal(similarity, -9)
        return float((places[similarity.argmax(axis=1)] == places).mean())

    learnt = places < 200
    projection, mean = learn_whitening(vectors[learnt], places[learnt])
    assert projection.shape[0] == GLOBAL_DIM
    others, places = vectors[~learnt], places[~learnt]
    assert recall((others - mean) @ projection.T) > recall(others - mean) + 0.2


def test_the_head_sees_the_mean_of_a_cells_descriptors() -> None:
    made, image = network("base", 3), torch.randn(1, 1, 64, 96)
    with torch.no_grad():
        _, fused = made.look(image)
        cells = GlobalHead(made).desc(fused)
        expected = torch.nn.functional.avg_pool2d(made.desc(fused), 2)
    torch.testing.assert_close(cells, expected, atol=2e-3, rtol=1e-2)
