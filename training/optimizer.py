"""Muon for convolutions: torch's own takes matrices only."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

_ITERATIONS = 5
_COEFFICIENTS = (3.4445, -4.7750, 2.0315)
_ADAMW_RMS = 0.2  # of a step of AdamW, as a share of its rate


class Muon(torch.optim.Optimizer):
    """Momentum, made orthogonal: a step goes as far in every direction (Jordan et al., 2024).

    Steps are about as long as AdamW's of the same rate (Liu et al., arXiv:2502.16982).

    Parameters
    ----------
    params : of two or more dimensions, the first of which is the rows, all others the columns
    lr, momentum, weight_decay : float
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: float,
        momentum: float = 0.95,
        weight_decay: float = 0.01,
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self) -> None:
        """Make one step."""
        for group in self.param_groups:
            rate, momentum = group["lr"], group["momentum"]
            for p in group["params"]:
                state = self.state[p]
                if not state:
                    state["mean"] = torch.zeros_like(p)
                mean = state["mean"].lerp_(p.grad, 1 - momentum)
                step = orthogonalize(p.grad.lerp(mean, momentum).flatten(1))
                length = _ADAMW_RMS * max(step.shape) ** 0.5
                p.mul_(1 - rate * group["weight_decay"])
                p.sub_(step.reshape(p.shape), alpha=rate * length)


def orthogonalize(matrix: Tensor) -> Tensor:
    """Bring the singular values of (M, N) to between 0.7 and 1.2, by Newton-Schulz iterations."""
    a, b, c = _COEFFICIENTS
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = x / (x.norm() + 1e-7)
    for _ in range(_ITERATIONS):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.T if tall else x
