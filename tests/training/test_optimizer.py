import pytest

torch = pytest.importorskip("torch", reason="training needs the extra `train`")

from training.optimizer import Muon, orthogonalize


@pytest.mark.parametrize("shape", [(12, 40), (40, 12), (16, 16)])
def test_a_step_goes_as_far_in_every_direction(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    u, s, v = torch.linalg.svd(torch.randn(shape), full_matrices=False)
    uneven = u @ torch.diag(torch.linspace(0.1, 5, len(s))) @ v
    made = orthogonalize(uneven)
    values = torch.linalg.svdvals(made)
    assert values.min() > 0.5
    assert values.max() < 1.3
    turned = u.T @ made @ v.T  # the directions are the same
    torch.testing.assert_close(turned, turned.diag().diag(), atol=1e-3, rtol=0)


def test_steps_are_as_long_as_those_of_adamw() -> None:
    torch.manual_seed(0)
    weight = torch.nn.Parameter(torch.zeros(32, 16, 3, 3))
    weight.grad = torch.randn_like(weight)
    Muon([weight], lr=0.01, weight_decay=0.0).step()
    assert weight.detach().square().mean().sqrt() == pytest.approx(0.2 * 0.01, rel=0.25)


def test_the_least_squares_are_found() -> None:
    torch.manual_seed(0)
    truth, x = torch.randn(8, 20), torch.randn(200, 20)
    weight = torch.nn.Parameter(torch.zeros(8, 20))
    optimizer = Muon([weight], lr=0.1, weight_decay=0.0)
    for step in range(200):
        optimizer.param_groups[0]["lr"] = 0.1 * (1 - step / 200)
        weight.grad = None
        (x @ (weight - truth).T).square().mean().backward()
        optimizer.step()
    torch.testing.assert_close(weight.detach(), truth, atol=0.05, rtol=0)
