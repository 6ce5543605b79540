"""The U-Net of Open Image Denoise (OIDN) as a PyTorch module. Attribute names are the keys of the weight files."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .config import UNETS, ModelConfig
from .network import CHANNELS, OPEN_BIAS, Fusion

SIZES = {
    "small": (((32, 32), (32,), (32,), (32,)), (32, 32), ((64, 64), (64, 64), (64, 32), (32, 32))),
    "base": (((32, 32), (48,), (64,), (80,)), (96, 96), ((112, 112), (96, 96), (64, 64), (64, 32))),
    "medium": (((48, 64), (96, 96), (128, 128), (192, 192)), (256, 256), ((192, 192), (128, 128), (96, 96), (48, 48))),
    "large": (((64, 64), (96, 96), (128, 128), (192, 192)), (256, 256), ((192, 192), (128, 128), (96, 96), (64, 64))),
}
"""Output channels of the convolutions: encoder from the full resolution down, bottom, decoder from the deepest up."""
GUIDES = {"none": (), "albedo": (6,), "albedo-normal": (6, 0)}
"""The first feature channel of each guide, in the order of the network's input."""
SIDE_WIDTHS = (1, 2, 4, 4)
"""Channels of the second encoder's levels as multiples of the width, from the full resolution down."""
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


class SideEncoder(nn.Module):
    """An encoder of the features, or of their detail map, whose maps are added to those of the decoder."""

    def __init__(self, source: str, width: int, decoder: Sequence[int]) -> None:
        """`source` is "features" or "detail"; `decoder` has its channels, from the full resolution down."""
        super().__init__()
        self.fusion = Fusion(width) if source == "detail" else None
        channels = [width * factor for factor in SIDE_WIDTHS]
        inputs = (CHANNELS[source], *channels)
        self.levels = nn.ModuleList(Level(a, (b, b)) for a, b in zip(inputs, channels))
        sides = reversed(list(zip(decoder, channels)))
        self.fuses = nn.ModuleList(nn.Conv2d(own + side, own, 1) for own, side in sides)

    def forward(self, features: Tensor) -> list[Tensor]:
        """[B, 12, H, W] -> the maps, from the full resolution down."""
        x = features if self.fusion is None else self.fusion(features)
        maps = []
        for level in self.levels:
            x = level(F.max_pool2d(x, 2) if maps else x)
            maps.append(x)
        return maps


class Unet(nn.Module):
    """The network: the input is the last skip. `UNETS` says what the encoder beside it takes, if it has one."""

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
        decoded = [outputs[-1] for outputs in reversed(decoder)]
        source = UNETS[config.variant]
        self.side = SideEncoder(source, config.width, decoded) if source else None
        self._initialise()

    @torch.no_grad()
    def _initialise(self) -> None:
        for conv in self.modules():
            if isinstance(conv, nn.Conv2d):
                nn.init.xavier_uniform_(conv.weight)
                nn.init.zeros_(conv.bias)
        if self.side is not None:
            for conv in self.side.fuses:
                nn.init.zeros_(conv.weight)
                nn.init.eye_(conv.weight[: len(conv.weight), : len(conv.weight), 0, 0])
            if self.side.fusion is not None:
                self.side.fusion.blocks[-1].conv.bias.fill_(OPEN_BIAS)

    def forward(self, color: Tensor, features: Tensor) -> Tensor:
        """Colour [B, 3, H, W] and features [B, 12, H, W], both in OIDN's value ranges -> [B, 3, H, W], not negative."""
        x = torch.cat((color, *(features[:, first : first + 3] for first in self.guides)), 1)
        side = None if self.side is None else self.side(features)
        skips = []
        for level in self.encoder:
            skips.append(x)
            x = F.max_pool2d(level(x), 2)
        x = self.bottom(x)
        for index, level in enumerate(self.decoder):
            x = level(torch.cat((F.interpolate(x, scale_factor=2, mode="nearest"), skips.pop()), 1))
            if side is not None:
                x = F.relu(self.side.fuses[index](torch.cat((x, side.pop()), 1)))
        return F.relu(self.head(x))
