"""Layers of a network without kernels: images of their own that are scaled to add up to the image. No PyTorch.

The definition is in docs/denoising.md. Layers are planes [H, W] by name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

SUM_TOLERANCE = 1e-3
"""Noisy layers add up to the colour if their sum differs from it by at most this share of it."""


def layer_color(name: str) -> int:
    """The colour channel that a layer belongs to: 0 for names that end in R, 1 in G, 2 in B, else 3."""
    return {"r": 0, "g": 1, "b": 2}.get(name.rpartition(".")[2].lower(), 3)


def layer_images(names: Iterable[str]) -> list[tuple[str, ...]]:
    """The names of each image: red, green, and blue if they differ only in the last part, else a single name."""
    images, left = [], list(names)
    while left:
        group = [name for name in left if name.rpartition(".")[0] == left[0].rpartition(".")[0]]
        colors = [next((name for name in group if layer_color(name) == color), None) for color in range(3)]
        image = tuple(colors) if left[0] in colors and None not in colors else (left[0],)
        images.append(image)
        left = [name for name in left if name not in image]
    return images


def scaled(
    denoised: Mapping[str, np.ndarray],
    layers: Mapping[str, np.ndarray],
    color_hdr: np.ndarray,
    image: np.ndarray,
) -> dict[str, np.ndarray]:
    """Denoised layers of which those of colour add up to the denoised `image`.

    They stay as they are if the noisy `layers` do not add up to the noisy colour.
    """
    colors = [names for names in layer_images(layers) if len(names) == 3]
    if not colors:
        return dict(denoised)
    difference = np.abs(_sum(layers, colors) - color_hdr).sum(dtype=np.float64)
    if difference > SUM_TOLERANCE * np.abs(color_hdr).sum(dtype=np.float64):
        return dict(denoised)
    total = _sum(denoised, colors)
    with np.errstate(all="ignore"):
        ratios = image / total
    ratios = np.where((total > 0) & np.isfinite(ratios), ratios, np.float32(1))
    factors = {name: plane for names in colors for name, plane in zip(names, ratios)}
    return {name: plane * factors.get(name, np.float32(1)) for name, plane in denoised.items()}


def _sum(planes: Mapping[str, np.ndarray], images: Sequence[tuple[str, ...]]) -> np.ndarray:
    return sum(np.stack([np.float32(planes[name]) for name in names]) for names in images)
