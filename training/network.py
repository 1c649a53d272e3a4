"""The network: keypoint scores and dense descriptors of a gray image, in one pass.

Convolution, batch norm, ReLU, bilinear resize and pixel shuffle only: nothing that quantises badly.
Downsampling convolutions have even kernels, so that the cells of every scale are centred on blocks
of input pixels: cell i of stride s covers the pixels s i to s i + s - 1.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional as F

DESCRIPTOR_DIM = 64
STRIDE = 32  # H and W of the input are multiples of it


@dataclass(frozen=True)
class Profile:
    """The width (channels) and depth (residual blocks) at strides 2, 4, 8, 16 and 32.

    No channels at stride 2: the first layer goes to stride 4 at once.
    """

    channels: tuple[int, int, int, int, int]
    blocks: tuple[int, int, int, int, int]
    fusion: int  # channels in which the scales are summed for the descriptors
    detector: int  # and for the scores
    descriptor_stride: int = 4
    words: int = 32  # of the global descriptor


PROFILES = {
    "tiny": Profile((0, 16, 32, 64, 64), (0, 1, 1, 1, 1), 48, 16, 8),
    "base": Profile((16, 32, 64, 128, 128), (0, 1, 2, 2, 1), 80, 32, words=64),
    "large": Profile((24, 48, 96, 160, 192), (0, 2, 3, 3, 2), 160, 48),
}


def _convolution(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    padding = {2: 0, 3: 1, 4: 1, 8: 2}[kernel]
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    )


class Residual(nn.Module):
    """Two 3x3 convolutions beside the identity (He et al., CVPR 2016)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _convolution(channels, channels, 3)
        self.second = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to the same shape."""
        return F.relu(x + self.norm(self.second(self.first(x))))


def _stage(inputs: int, outputs: int, blocks: int, kernel: int, stride: int = 2) -> nn.Sequential:
    down = _convolution(inputs, outputs, kernel, stride)
    return nn.Sequential(down, *(Residual(outputs) for _ in range(blocks)))


class Network(nn.Module):
    """Image to score logits and descriptors.

    Parameters
    ----------
    profile : Profile
        Its size.

    Takes (B, 1, H, W) float32, standardised by `standardize`; gives logits (B, 1, H, W) and
    descriptors (B, 64, H/s, W/s), not normalised.
    """

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        self.profile = profile
        c, n = profile.channels, profile.blocks
        first = (
            [_stage(1, c[0], n[0], 4), _stage(c[0], c[1], n[1], 4)]
            if c[0]
            else [nn.Identity(), _stage(1, c[1], n[1], 8, 4)]
        )
        others = [_stage(c[i - 1], c[i], n[i], 2) for i in range(2, 5)]
        self.scales = nn.ModuleList(first + others)
        # Descriptors are fused at stride 8 and, but for the least profile, given at stride 4.
        f, d = profile.fusion, profile.detector
        self.fuse4 = nn.Conv2d(c[1], f, 2, 2, bias=False)
        self.fuse8 = nn.Conv2d(c[2], f, 1)
        self.fuse16 = nn.Conv2d(c[3], f, 1, bias=False)
        self.fuse32 = nn.Conv2d(c[4], f, 1, bias=False)
        self.fused = nn.Sequential(nn.BatchNorm2d(f), nn.ReLU(), _convolution(f, f, 3))
        zoom = 8 // profile.descriptor_stride
        self.desc = (
            nn.ConvTranspose2d(f, DESCRIPTOR_DIM, zoom, zoom)
            if zoom > 1
            else nn.Conv2d(f, DESCRIPTOR_DIM, 1)
        )
        # Scores are fused at stride 4; the last layer has sixteen in each cell.
        self.detect4 = nn.Conv2d(c[1], d, 1)
        self.detect8 = nn.Conv2d(f, d, 1, bias=False)
        self.detected = nn.Sequential(nn.BatchNorm2d(d), nn.ReLU(), _convolution(d, d, 3))
        self.score = nn.Conv2d(d, 16, 3, padding=1)
        nn.init.constant_(self.score.bias, -4.0)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (B, 1, H, W) and descriptors (B, 64, H/s, W/s)."""
        score, fused = self.look(image)
        return score, self.desc(fused)

    def look(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits, and what the descriptors are made of, (B, fusion, H/8, W/8)."""
        x4 = self.scales[1](self.scales[0](image))
        x8 = self.scales[2](x4)
        x16 = self.scales[3](x8)
        x32 = self.scales[4](x16)
        fused = self.fused(
            self.fuse4(x4) + self.fuse8(x8) + _double(self.fuse16(x16) + _double(self.fuse32(x32)))
        )
        detected = self.detected(self.detect4(x4) + _double(self.detect8(fused)))
        return F.pixel_shuffle(self.score(detected), 4), fused

    def mean_desc(self) -> nn.Conv2d:
        """Return the layer from `fused` to the mean of the descriptors of each cell of stride 8."""
        if isinstance(self.desc, nn.Conv2d):
            return self.desc
        weight = self.desc.weight.detach().mean(dim=(2, 3)).T
        layer = nn.Conv2d(*weight.shape[::-1], 1)
        layer.weight.data = weight[:, :, None, None].contiguous()
        layer.bias.data = self.desc.bias.detach().clone()
        return layer


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def grow(network: Network, state: dict[str, Tensor]) -> None:
    """Start from a smaller network's weights, and compute what it does (Chen et al., ICLR 2016).

    Shared channels take its weights; what new channels give is ignored at first; new residual
    blocks are the identity.
    """
    own = network.state_dict()
    for name, block in network.named_modules():
        if isinstance(block, Residual) and f"{name}.norm.weight" not in state:
            nn.init.zeros_(block.norm.weight)
    for name, values in own.items():
        if name not in state or not values.ndim:
            continue
        old = state[name]
        shared = tuple(slice(0, size) for size in old.shape)
        if name == "desc.weight":  # of a transposed convolution: inputs first
            values[old.shape[0] :] = 0
        elif values.ndim == 4:
            values[: old.shape[0], old.shape[1] :] = 0
        values[shared] = old
    network.load_state_dict(own)
