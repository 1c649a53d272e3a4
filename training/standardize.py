"""What trigpoint does to an image before the network sees it, for tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def standardize(images: Tensor) -> Tensor:
    """Do to gray levels (B, 1, H, W) float32 what FeatureModel does to each image."""
    mean = images.mean(dim=(2, 3), keepdim=True)
    std = images.std(dim=(2, 3), keepdim=True, correction=0).clamp(min=4.0)
    standard = ((images - mean) / std).clamp(-4, 4)
    return standard.contiguous(memory_format=torch.channels_last)
