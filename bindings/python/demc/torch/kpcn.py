"""KPCN (Bako et al. 2017) as a PyTorch module: the kernel-predicting networks that the paper compares with.

One network denoises diffuse light, divided by the albedo, the other the logarithm of specular light. Convolutions pad
with zeros, kernels replicate the border. Attribute names are the keys of the weight files.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .config import ModelConfig
from .network import DARKEST, filtered

LAYERS = 9
"""Convolutions of a network."""
SIDE = 21
"""Side of a kernel in pixels."""
INPUTS = 34
"""Channels that a network takes as input."""
SURFACE = (3, 3, 1)
"""Channels of normal, albedo, and depth."""
VARIANCES = 7
"""Index of the first of five variances among the features."""


class KernelNetwork(nn.Module):
    """Nine 5x5 convolutions: [B, 34, H, W] -> logits [B, 441, H, W]."""

    def __init__(self, width: int) -> None:
        super().__init__()
        widths = (INPUTS, *[width] * (LAYERS - 1), SIDE**2)
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 5, padding=2) for a, b in zip(widths, widths[1:]))
        for conv in self.layers:
            nn.init.xavier_uniform_(conv.weight)
            nn.init.zeros_(conv.bias)

    def forward(self, x: Tensor) -> Tensor:
        for conv in self.layers[:-1]:
            x = F.relu(conv(x))
        return self.layers[-1](x)


class Kpcn(nn.Module):
    """The networks for diffuse and for specular light."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.diffuse = KernelNetwork(config.width)
        self.specular = KernelNetwork(config.width)

    def forward(self, light: Tensor, features: Tensor) -> Tensor:
        """Diffuse light / albedo and ln(1 + specular light) [B, 6, H, W] -> the same, denoised.

        `features` are [B, 12, H, W]: normal, albedo, depth; the variances of diffuse and specular light, normal, albedo,
        and depth. The light has no gradient.
        """
        surface = []
        for index, planes in enumerate(features[:, :VARIANCES].split(SURFACE, 1)):
            variance = VARIANCES + 2 + index
            surface += [*with_differences(planes), features[:, variance : variance + 1]]
        denoised = []
        for part, network in enumerate((self.diffuse, self.specular)):
            color = light[:, 3 * part : 3 * part + 3].detach()
            variance = features[:, VARIANCES + part : VARIANCES + part + 1]
            logits = network(torch.cat((*with_differences(color), variance, *surface), 1))
            denoised.append(filtered(color, logits.softmax(1)))
        return torch.cat(denoised, 1)


def with_differences(planes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The planes [B, C, H, W], their differences to the pixel on the left, and to the one above; 0 at the border."""
    across, down = torch.zeros_like(planes), torch.zeros_like(planes)
    across[..., 1:] = planes[..., 1:] - planes[..., :-1]
    down[..., 1:, :] = planes[..., 1:, :] - planes[..., :-1, :]
    return planes, across, down


def separate_loss(light: Tensor, reference: Tensor) -> Tensor:
    """The sum of both networks' mean absolute errors in their spaces, [B, 6, H, W] each; the mean over images."""
    return 2 * (light - reference).abs().mean()


def joined_hdr(light: Tensor, divisor: Tensor) -> Tensor:
    """Both parts [B, 6, H, W] together, in linear radiance [B, 3, H, W]; `divisor` is albedo + 0.00316, [B, 3, H, W]."""
    return (light[:, :3] * divisor + light[:, 3:].expm1()).clamp_min(DARKEST)
