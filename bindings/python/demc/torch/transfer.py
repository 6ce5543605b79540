"""The curve between linear radiance and the network's colour: a power, or that of Open Image Denoise (OIDN)."""

from __future__ import annotations

import torch
from torch import Tensor

from .metrics import gamma_from_hdr, hdr_from_gamma

PEAK = 65504.0
"""Radiance at which OIDN's curve is 1."""
A, B, C, D = 1412.83765, 1.64593172, 0.431384981, -0.00294139609
E, F, G = 0.192653254, 0.00626026094, 0.998620152
Y0, Y1 = 1.5794576e-6, 0.0322087631
X0, X1 = 0.00223151711, 0.370974749


def compress(color_hdr: Tensor, normalizer: dict) -> Tensor:
    """Linear radiance -> the network's colour, before albedo demodulation."""
    if normalizer.get("transfer", "gamma") == "gamma":
        return gamma_from_hdr(color_hdr, normalizer["gamma"])
    return compress_pu(color_hdr)


def expand(color: Tensor, normalizer: dict) -> Tensor:
    """The network's colour, after albedo modulation -> linear radiance."""
    if normalizer.get("transfer", "gamma") == "gamma":
        return hdr_from_gamma(color, normalizer["gamma"])
    return expand_pu(color)


def compress_pu(color_hdr: Tensor) -> Tensor:
    """Linear radiance -> OIDN's colour, 1 at the peak."""
    return pu(color_hdr.clamp_min(0)) / pu(torch.tensor(PEAK))


def expand_pu(color: Tensor) -> Tensor:
    """OIDN's colour -> linear radiance."""
    x = color.clamp_min(0) * pu(torch.tensor(PEAK))
    middle = ((x.clamp(X0, X1) - D) / B) ** (1 / C)
    bright = torch.exp((x.clamp_min(X1) - G) / E) - F
    return torch.where(x <= X0, x / A, torch.where(x <= X1, middle, bright))


def pu(y: Tensor) -> Tensor:
    """OIDN's curve of a radiance that is not negative."""
    middle = B * y.clamp(Y0, Y1) ** C + D
    bright = E * torch.log(y.clamp_min(Y1) + F) + G
    return torch.where(y <= Y0, A * y, torch.where(y <= Y1, middle, bright))
