"""The conversions of an image before the network that need the whole image. No PyTorch.

The rest (gamma, albedo demodulation, Z-score) is in `bundle.py` and inside the ONNX graph.
`meta` is the header of an exported file: `Bundle.meta`, or the key ``demc`` of an ONNX file.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .config import UNETS

FEATURES = 12
"""Normal xyz, world position xyz, albedo RGB (first hit), albedo RGB (second hit) (Sec. 3.1)."""
SIZE_MULTIPLE = 32
"""Heights and widths must be multiples of this: five max-pools of 2."""
UNET_MULTIPLE = 16
"""The same for U-Nets: four max-pools of 2."""
GAMMA = 2.2
"""Exponent of the colour compression (Eq. 4)."""
MAX_INPUT_SCALE = 1e6
"""Largest factor on the colour, and the inverse of the smallest."""
EXPOSURE_TOLERANCE = 2.0
"""Exposures up to this factor outside the training scenes' range are not scaled."""
FARTHEST = 5.0
"""Largest absolute position relative to the image."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 luminance of red, green and blue."""
OIDN_LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)
"""The luminance of Open Image Denoise."""
BIN = 16
"""Side in pixels of the bins that Open Image Denoise measures the exposure in."""


class Prepared(NamedTuple):
    """The input of the ONNX graph and of `Bundle.radiance`, without batch dimension."""

    color: np.ndarray  # [3, H, W] float32, linear radiance times `scale`
    features: np.ndarray  # [12, H, W] float32
    scale: np.float32  # the output is divided by it


def prepare(color_hdr: np.ndarray, features: np.ndarray, meta: dict, scale: float | None = None) -> Prepared:
    """Converts a whole image, before it is cropped or padded.

    `color_hdr` is [3, H, W] linear radiance. `features` is [12, H, W] as rendered. `scale` is
    `input_scale(color_hdr, meta)` by default. Raises ValueError for other shapes, NaN, and infinite
    values.
    """
    height, width = color_hdr.shape[-2:]
    for what, array, channels in (("color_hdr", color_hdr, 3), ("features", features, FEATURES)):
        if array.shape != (channels, height, width):
            raise ValueError(f"{what} is {list(array.shape)}: expected [{channels}, {height}, {width}]")
        if not np.isfinite(array).all():
            raise ValueError(f"{what} contains NaN or infinite values")
    scale = np.float32(input_scale(color_hdr, meta) if scale is None else scale)
    return Prepared(np.float32(color_hdr) * scale, map_positions(np.float32(features), meta), scale)


def pad(image: np.ndarray, meta: dict | None = None) -> np.ndarray:
    """Colour or features [C, H, W], padded at the right and the bottom to the sizes that the network takes.

    Edges are repeated up to multiples of 32. For a U-Net, `meta` says so, black and the features' means are
    appended up to multiples of 16.
    """
    height, width = image.shape[-2:]
    if meta is None or meta["model"]["variant"] not in UNETS:
        return np.pad(image, ((0, 0), (0, -height % SIZE_MULTIPLE), (0, -width % SIZE_MULTIPLE)), "edge")
    size = [length + -length % UNET_MULTIPLE for length in (height, width)]
    fill = meta["normalizer"]["features"]["mean"] if len(image) == FEATURES else [0.0] * len(image)
    padded = np.empty((len(image), *size), image.dtype)
    padded[:] = np.array(fill)[:, None, None]
    padded[:, :height, :width] = image
    return padded


def input_scale(color_hdr: np.ndarray, meta: dict) -> float:
    """The factor on colour [3, H, W] before the network, which its output is divided by.

    With `normalizer.exposure_level`, it brings each image to that exposure. Without, it is 1 within
    a stop of the training scenes' exposures, and for a file without ranges. Other images come to
    the middle of the training scenes' exposures. A black image has the factor 1. One factor serves
    a whole sequence and all tiles of an image.
    """
    exposure = exposure_of(color_hdr, meta["normalizer"].get("transfer", "gamma"))
    if exposure == 0:
        return 1.0
    level = meta["normalizer"].get("exposure_level")
    if level is None:
        if (ranges := meta.get("ranges")) is None:
            return 1.0
        low, high = (ranges["exposure"][end] for end in ("low", "high"))
        if low / EXPOSURE_TOLERANCE <= exposure <= high * EXPOSURE_TOLERANCE:
            return 1.0
        level = (low * high) ** 0.5
    return float(np.float32(np.clip(level / exposure, 1 / MAX_INPUT_SCALE, MAX_INPUT_SCALE)))


def exposure_of(color_hdr: np.ndarray, transfer: str = "gamma") -> float:
    """``mean(luminance^(1/2.2))^2.2`` of linear colour [3, H, W]; 0 for a black image.

    With the curve of Open Image Denoise, `transfer` "pu": the geometric mean of the luminance of bins of 16x16 pixels.
    """
    if transfer == "pu":
        return exposure_of_bins(color_hdr)
    luminance = np.tensordot(LUMINANCE, np.float32(color_hdr), 1)
    return float(np.mean(np.maximum(luminance, 0).astype(np.float64) ** (1 / GAMMA)) ** GAMMA)


def exposure_of_bins(color_hdr: np.ndarray) -> float:
    """The exposure of [3, H, W] as Open Image Denoise measures it. Bins below 1e-8 do not count."""
    luminance = np.tensordot(OIDN_LUMINANCE, np.maximum(np.float32(color_hdr), 0), 1).astype(np.float64)
    rows, columns = (
        [i * length // -(-length // BIN) for i in range(-(-length // BIN))] for length in luminance.shape
    )
    sums = np.add.reduceat(np.add.reduceat(luminance, rows, 0), columns, 1)
    heights, widths = (np.diff([*starts, end]) for starts, end in zip((rows, columns), luminance.shape))
    means = sums / np.outer(heights, widths)
    means = means[means > 1e-8]
    return float(2 ** np.log2(means).mean()) if means.size else 0.0


def map_positions(features: np.ndarray, meta: dict) -> np.ndarray:
    """Features [12, H, W] with the positions that the network takes as input.

    In the position space "image", positions are centred at their median and divided by the median
    distance from it; without a hit they are 0. The whole image must be given.
    """
    if meta["normalizer"].get("position", "scene") == "scene":
        return features
    features = np.array(features, np.float32)
    hit = (features[:6] != 0).any(0)
    features[3:6] = relative_positions(features[3:6], hit)
    return features


def relative_positions(positions: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Positions [3, H, W] relative to the image; `hit` [H, W] is true where a surface is hit."""
    points = positions[:, hit]
    if points.size == 0:
        return np.zeros_like(positions)
    middle = points.shape[1] // 2
    center = np.partition(points, middle, 1)[:, middle]
    distances = np.sqrt(((points - center[:, None]) ** 2).sum(0))
    extent = np.partition(distances, middle)[middle] or distances.mean()
    if extent == 0:
        return np.zeros_like(positions)
    mapped = np.clip((positions - center[:, None, None]) / extent, -FARTHEST, FARTHEST)
    return np.where(hit, mapped, np.float32(0))
