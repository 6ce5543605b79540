"""RelMSE, and conversions between gamma space and linear radiance."""

from torch import Tensor

from .preprocess import GAMMA

EPSILON = 0.001
"""Keeps RelMSE finite where the reference is black (Eq. 5)."""


def gamma_from_hdr(hdr: Tensor, gamma: float = GAMMA) -> Tensor:
    """Linear radiance -> gamma space: ``max(x, 0)^(1/gamma)`` (Eq. 4)."""
    return hdr.clamp(min=0) ** (1 / gamma)


def hdr_from_gamma(color: Tensor, gamma: float = GAMMA) -> Tensor:
    """Gamma space -> linear radiance: ``x^gamma``. `color` must not be negative."""
    return color**gamma


def rel_mse(out_hdr: Tensor, ref_hdr: Tensor, epsilon: float = EPSILON) -> Tensor:
    """RelMSE of [B, 3, H, W] linear images (Eq. 5): sum over channels, mean over pixels."""
    return ((ref_hdr - out_hdr) ** 2 / (ref_hdr**2 + epsilon)).sum(1).mean()
