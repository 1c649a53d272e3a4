"""What the network is asked for.

Scores: the teachers' keypoints at their sub-pixel places. Descriptors: those of the teachers, from
both views of a pair alike; and that the two views' points resemble one another as the teachers'
do, which teaches what must not be confused.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from training.network import DESCRIPTOR_DIM
from training.pairs import SIZE, Batch

TEACHER_SCALE = 25.0  # of similarities before the softmax
MAX_SCALE = 60.0
WEIGHTS = {"score": 0.5, "regression": 4.0, "matching": 0.6}


class Projection(nn.Module):
    """The teachers' joint descriptors (192) in DESCRIPTOR_DIM principal components.

    Around their mean, so that the network's descriptors have none worth subtracting.
    """

    def __init__(self, taught: Tensor) -> None:
        super().__init__()
        mean = taught.mean(dim=0)
        _, columns = torch.linalg.eigh((taught - mean).T.cov())
        self.register_buffer("mean", mean)
        self.register_buffer("rows", columns[:, -DESCRIPTOR_DIM:].T.contiguous())

    def forward(self, taught: Tensor) -> Tensor:
        """Project (..., 192) to (..., 64), unit length."""
        return F.normalize((taught - self.mean) @ self.rows.T, dim=-1)


class Losses(nn.Module):
    """All losses of a batch; holds the learnt scale of similarities."""

    def __init__(self, projection: Projection) -> None:
        super().__init__()
        self.projection = projection
        self.log_scale = nn.Parameter(torch.tensor(16.0).log())

    def forward(self, scores: Tensor, descriptors: Tensor, batch: Batch) -> dict[str, Tensor]:
        """Return the losses by name, unweighted, and the share of points matched right."""
        heat = batch.heat.float() / 255
        half = len(descriptors) // 2
        sides = [sample(descriptors[half * i : half * (i + 1)], batch.points[i]) for i in range(2)]
        target = self.projection(batch.taught)
        valid = batch.valid.float()
        distance = sum(1 - (side * target).sum(dim=-1) for side in sides)
        matching, top1 = self._matching(sides, batch)
        return {
            "score": score_loss(scores.float(), heat),
            "regression": (distance * valid).sum() / (2 * valid.sum()),
            "matching": matching,
            "top1": top1,
        }

    def _matching(self, sides: list[Tensor], batch: Batch) -> tuple[Tensor, Tensor]:
        """Cross-entropy of the teachers' distribution over the other view's points."""
        both = batch.valid[:, :, None] & batch.valid[:, None, :]
        scale = self.log_scale.exp().clamp(max=MAX_SCALE)
        similarity = (scale * sides[0] @ sides[1].mT).masked_fill(~both, -1e4)
        taught = TEACHER_SCALE * batch.taught @ batch.taught.mT
        taught = taught.masked_fill(~both, -1e4).softmax(dim=2)
        valid = batch.valid.float()
        count = valid.sum()
        loss = similarity.new_zeros(())
        for logits in (similarity, similarity.mT):
            entropy = -(taught * logits.log_softmax(dim=2)).sum(dim=2)
            loss = loss + (entropy * valid).sum() / (2 * count)
        places = torch.arange(similarity.shape[1], device=similarity.device)
        right = (similarity.argmax(dim=2) == places) & batch.valid
        return loss, right.float().sum() / count


def sample(descriptors: Tensor, points: Tensor) -> Tensor:
    """Sample (B, D, h, w) at x, y (B, N, 2) in px of the input: (B, N, D), unit length."""
    grid = (points + 0.5) / SIZE * 2 - 1
    sampled = F.grid_sample(descriptors.float(), grid[:, None], align_corners=False)
    return F.normalize(sampled[:, :, 0].mT, dim=-1)


def score_loss(logits: Tensor, heat: Tensor) -> Tensor:
    """Quality focal loss (Li et al., NeurIPS 2020), which takes soft targets, per keypoint.

    Where it is least the logit near a keypoint is the logarithm of a Gaussian, a parabola: the
    sub-pixel fit of the peak is then exact.
    """
    error = (heat - logits.sigmoid()).square()
    entropy = F.binary_cross_entropy_with_logits(logits, heat, reduction="none")
    keypoints = heat.sum() / 4.0  # the blob's mass, 2 pi sigma^2
    return (error * entropy).sum() / keypoints.clamp(min=20.0)
