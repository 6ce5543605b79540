"""The U-Net of Open Image Denoise (OIDN) as a PyTorch module. Attribute names are the keys of the weight files."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .config import ModelConfig

SIZES = {
    "small": (((32, 32), (32,), (32,), (32,)), (32, 32), ((64, 64), (64, 64), (64, 32), (32, 32))),
    "base": (((32, 32), (48,), (64,), (80,)), (96, 96), ((112, 112), (96, 96), (64, 64), (64, 32))),
    "large": (((64, 64), (96, 96), (128, 128), (192, 192)), (256, 256), ((192, 192), (128, 128), (96, 96), (64, 64))),
}
"""Output channels of the convolutions: encoder from the full resolution down, bottom, decoder from the deepest up."""
GUIDES = {"none": (), "albedo": (6,), "albedo-normal": (6, 0)}
"""The first feature channel of each guide, in the order of the network's input."""
HALVINGS = 4
"""Heights and widths must be multiples of 2 to this power."""


class Level(nn.Module):
    """3x3 convolutions with ReLU."""

    def __init__(self, inputs: int, outputs: tuple[int, ...]) -> None:
        super().__init__()
        self.convs = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in zip((inputs, *outputs), outputs))

    def forward(self, x: Tensor) -> Tensor:
        for conv in self.convs:
            x = F.relu(conv(x))
        return x


class Unet(nn.Module):
    """The network: the input is the last skip."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        encoder, bottom, decoder = SIZES[config.size]
        self.guides = GUIDES[config.guides]
        channels = 3 * (1 + len(self.guides))
        skips = [channels]
        self.encoder = nn.ModuleList()
        for outputs in encoder:
            self.encoder.append(Level(channels, outputs))
            channels = outputs[-1]
            skips.append(channels)
        self.bottom = Level(channels, bottom)
        channels = bottom[-1]
        self.decoder = nn.ModuleList()
        for outputs, skip in zip(decoder, reversed(skips[:-1])):
            self.decoder.append(Level(channels + skip, outputs))
            channels = outputs[-1]
        self.head = nn.Conv2d(channels, 3, 3, padding=1)
        for conv in self.modules():
            if isinstance(conv, nn.Conv2d):
                nn.init.xavier_uniform_(conv.weight)
                nn.init.zeros_(conv.bias)

    def forward(self, color: Tensor, features: Tensor) -> Tensor:
        """Colour [B, 3, H, W] and features [B, 12, H, W], both in OIDN's value ranges -> [B, 3, H, W], not negative."""
        x = torch.cat((color, *(features[:, first : first + 3] for first in self.guides)), 1)
        skips = []
        for level in self.encoder:
            skips.append(x)
            x = F.max_pool2d(level(x), 2)
        x = self.bottom(x)
        for level in self.decoder:
            x = level(torch.cat((F.interpolate(x, scale_factor=2, mode="nearest"), skips.pop()), 1))
        return F.relu(self.head(x))
