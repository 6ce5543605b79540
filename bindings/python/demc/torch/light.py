"""The light of the noisy image, given back to the denoised one. No PyTorch.

The definition is in docs/denoising.md. `meta` is the header of an exported file: `Bundle.meta`, or the
key ``demc`` of an ONNX file.
"""

from __future__ import annotations

import numpy as np

BLOCK = 4
"""Height and width of a block in pixels."""
DEVIATION, RADIUS = 3.0, 9
"""Standard deviation of the Gaussian, and its largest distance, in blocks."""
LOWEST, HIGHEST = 0.8, 1.25
"""Limits of a factor."""
DARK = 1e-30
"""Weights below this are no light."""


def factors(noisy: np.ndarray, denoised: np.ndarray, meta: dict) -> np.ndarray:
    """The factors on a whole denoised image. All are 1 for a model without `data.restore_light`.

    Both images are [3, H, W] linear radiance; returns [3, H, W] float32.
    """
    if not meta["normalizer"].get("restore_light", False):
        return np.ones_like(denoised)
    noisy, denoised = (np.maximum(image, 0).astype(np.float64) for image in (noisy, denoised))
    around = _around(noisy, denoised)
    return (around * _overall(noisy, denoised * around)).astype(np.float32)


def _around(noisy: np.ndarray, denoised: np.ndarray) -> np.ndarray:
    """Factors from the means around each pixel."""
    _, height, width = noisy.shape
    distances = np.arange(-RADIUS, RADIUS + 1) / DEVIATION
    kernel = np.exp(-0.5 * distances**2)
    missing = noisy - denoised
    pixels, light, weights = (_blurred(_blocks(plane), kernel) for plane in (np.ones_like(noisy), missing, denoised**1.5))
    ratio = _ratio(pixels, light, _blurred(_blocks(missing**2), kernel**2), weights)
    for axis, length in ((1, height), (2, width)):
        at = ((np.arange(length) + 0.5) / BLOCK - 0.5).clip(0, ratio.shape[axis] - 1)
        first = at.astype(int)
        second = np.minimum(first + 1, ratio.shape[axis] - 1)
        share = np.expand_dims(at - first, 2 - axis)
        ratio = ratio.take(first, axis) * (1 - share) + ratio.take(second, axis) * share
    return _limited(ratio, denoised)


def _overall(noisy: np.ndarray, denoised: np.ndarray) -> np.ndarray:
    """Factors from the means of the whole image."""
    missing = noisy - denoised
    pixels = np.full_like(missing, 1)
    sums = (plane.sum((1, 2), keepdims=True) for plane in (pixels, missing, missing**2, denoised**1.5))
    return _limited(_ratio(*sums), denoised)


def _limited(ratio: np.ndarray, denoised: np.ndarray) -> np.ndarray:
    return (1 + ratio * np.sqrt(denoised)).clip(LOWEST, HIGHEST)


def _ratio(pixels: np.ndarray, missing: np.ndarray, squares: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The missing light per weight, less what noise explains."""
    usable = (weights > DARK * pixels) & (missing**2 > squares)
    share = 1 - squares / np.where(usable, missing**2, 1)
    return np.where(usable, share * missing / np.where(usable, weights, 1), 0)


def _blocks(planes: np.ndarray) -> np.ndarray:
    """Sums over blocks, [C, H, W] to [C, rows, columns]."""
    for axis in (1, 2):
        planes = np.add.reduceat(planes, np.arange(0, planes.shape[axis], BLOCK), axis)
    return planes


def _blurred(blocks: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Weighted sums around each block; there is nothing beyond the border."""
    for axis in (1, 2):
        length = blocks.shape[axis]
        padded = np.pad(blocks, [(RADIUS, RADIUS) if other == axis else (0, 0) for other in range(3)])
        blocks = sum(weight * padded.take(np.arange(length) + shift, axis) for shift, weight in enumerate(kernel))
    return blocks
