"""Bundles: safetensors files that `demc-infer export` writes, and denoising with them.

The header's key ``demc`` contains JSON: the model's configuration, the feature statistics of the
training set, the names of the renderer's channels, and the training step.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional as F

from .metrics import GAMMA, gamma_from_hdr, hdr_from_gamma
from .network import FEATURES, SIZE_MULTIPLE, Denoiser, ModelConfig

FORMAT = 1
"""The bundle format that this package reads."""
MAX_ALBEDO = 1.0
"""Larger albedo counts as this."""
MAX_INPUT_SCALE = 1e6
"""Largest factor on the colour, and the inverse of the smallest."""
EXPOSURE_TOLERANCE = 2.0
"""Exposures up to this factor outside the training scenes' range are not scaled."""
FARTHEST = 5.0
"""Largest absolute position relative to the image."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 luminance of red, green and blue."""
TORCH_FROM_BURN = {"gamma": "weight", "beta": "bias"}
"""Last part of a batch-normalisation key: Burn's name to PyTorch's."""


@dataclass
class Bundle:
    """A network in eval mode and the statistics of its training set."""

    model: Denoiser
    gamma: float
    feature_mean: Tensor  # [12]
    feature_std: Tensor  # [12]
    step: int
    meta: dict  # the whole header
    demodulate: float = 0.0  # epsilon of albedo demodulation; 0: off

    def input_scale(self, color_hdr: np.ndarray) -> float:
        """The factor on colour [3, H, W] before the network, which its output is divided by.

        It is 1 within a stop of the training scenes' exposures, for a black image, and for a bundle
        without ranges. Otherwise it brings the image to the middle of the training scenes'
        exposures. One factor serves a whole sequence and all tiles of an image.
        """
        ranges = self.meta.get("ranges")
        exposure = exposure_of(color_hdr)
        if ranges is None or exposure == 0:
            return 1.0
        low, high = (ranges["exposure"][end] for end in ("low", "high"))
        if low / EXPOSURE_TOLERANCE <= exposure <= high * EXPOSURE_TOLERANCE:
            return 1.0
        scale = (low * high) ** 0.5 / exposure
        return float(np.float32(np.clip(scale, 1 / MAX_INPUT_SCALE, MAX_INPUT_SCALE)))

    def map_positions(self, features: np.ndarray) -> np.ndarray:
        """Features [12, H, W] with the positions that the network takes as input.

        In the position space "image", positions are centred at their median and divided by the
        median distance from it; without a hit they are 0. The whole image must be given.
        """
        if self.meta["normalizer"].get("position", "scene") == "scene":
            return features
        features = np.array(features, np.float32)
        hit = (features[:6] != 0).any(0)
        features[3:6] = relative_positions(features[3:6], hit)
        return features

    def modulation(self, features: Tensor) -> Tensor:
        """The factor of albedo demodulation, in gamma space.

        [B, 12, H, W] features as rendered -> [B, 3, H, W]. The network's input colour is divided by
        it and its output multiplied by it. All ones if `demodulate` is 0.
        """
        texture = features[:, 6:9].clamp(0, MAX_ALBEDO)
        if self.demodulate == 0:
            return torch.ones_like(texture)
        return gamma_from_hdr(texture + self.demodulate, self.gamma)

    def features_z_from_raw(self, features: Tensor) -> Tensor:
        """[B, 12, H, W] features as rendered -> Z-scored."""
        shape = (1, FEATURES, 1, 1)
        features = torch.cat((features[:, :6], features[:, 6:].clamp_max(MAX_ALBEDO)), 1)
        return (features - self.feature_mean.view(shape)) / self.feature_std.view(shape)

    @torch.inference_mode()
    def denoise(
        self, color_hdr: np.ndarray, features: np.ndarray, input_scale: float | None = None
    ) -> np.ndarray:
        """Denoises one image of any size.

        `color_hdr` is [3, H, W] linear radiance. `features` is [12, H, W] as rendered: normal,
        position, albedo (first hit), albedo (second hit). Returns [3, H, W] linear radiance,
        float32. Edge pixels are repeated up to a multiple of 32 and cropped afterwards. The network
        sees the colour times `input_scale`, by default that of `input_scale(color_hdr)`.
        """
        height, width = color_hdr.shape[-2:]
        for what, array, channels in (("color_hdr", color_hdr, 3), ("features", features, FEATURES)):
            if array.shape != (channels, height, width):
                raise ValueError(f"{what} is {list(array.shape)}: expected [{channels}, {height}, {width}]")
            if not np.isfinite(array).all():
                raise ValueError(f"{what} contains NaN or infinite values")
        device = next(self.model.parameters()).device
        scale = self.input_scale(color_hdr) if input_scale is None else input_scale
        arrays = np.float32(color_hdr) * np.float32(scale), np.float32(self.map_positions(features))
        color, feats = (torch.from_numpy(array).to(device)[None] for array in arrays)
        pad = (0, -width % SIZE_MULTIPLE, 0, -height % SIZE_MULTIPLE)
        modulation = self.modulation(feats)
        color_gamma = F.pad(gamma_from_hdr(color, self.gamma) / modulation, pad, mode="replicate")
        features_z = F.pad(self.features_z_from_raw(feats), pad, mode="replicate")
        out = self.model(color_gamma, features_z)[0, :, :height, :width]
        return hdr_from_gamma(out * modulation[0], self.gamma).cpu().numpy() / np.float32(scale)

    def to(self, device: torch.device | str) -> Bundle:
        """Moves the network and the statistics to `device`, in place."""
        self.model.to(device)
        self.feature_mean, self.feature_std = self.feature_mean.to(device), self.feature_std.to(device)
        return self


def load(path: str | os.PathLike) -> Bundle:
    """Reads a bundle with Burn's or PyTorch's tensor names, in f32 or f16; f16 becomes f32.

    Raises OSError if the file cannot be read. Raises ValueError if it is not a bundle of this
    format, or if its tensors do not match the network in its header.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = (file.metadata() or {}).get("demc")
            weights = {torch_name_from(name): file.get_tensor(name).float() for name in file.keys()}
    except SafetensorError as error:
        raise ValueError(f"{path}: truncated, damaged, or not a safetensors file: {error}") from error
    if header is None:
        raise ValueError(f"{path}: no key 'demc' in the header: not written by demc-infer export")
    try:
        meta = json.loads(header)
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: header entry 'demc': not JSON: {error}") from error

    def entry(*keys: str) -> Any:
        value = meta
        for depth, key in enumerate(keys, 1):
            if not isinstance(value, dict) or key not in value:
                raise ValueError(f"{path}: header entry 'demc': no key {'.'.join(keys[:depth])}")
            value = value[key]
        return value

    if (found := entry("format")) != FORMAT:
        raise ValueError(f"{path}: bundle format {found}: this package reads format {FORMAT}")
    gamma, step = entry("normalizer", "gamma"), entry("step")
    demodulate = meta["normalizer"].get("demodulate", 0.0)
    mean, std = (torch.tensor(entry("normalizer", "features", key)) for key in ("mean", "std"))
    model = Denoiser(ModelConfig(**entry("model")))
    try:
        model.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error
    return Bundle(
        model=model.eval(),
        gamma=gamma,
        feature_mean=mean,
        feature_std=std,
        step=step,
        meta=meta,
        demodulate=demodulate,
    )


def exposure_of(color_hdr: np.ndarray) -> float:
    """``mean(luminance^(1/2.2))^2.2`` of linear colour [3, H, W]; 0 for a black image."""
    luminance = np.tensordot(LUMINANCE, np.float32(color_hdr), 1)
    return float(np.mean(np.maximum(luminance, 0).astype(np.float64) ** (1 / GAMMA)) ** GAMMA)


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


def torch_name_from(name: str) -> str:
    """The PyTorch name of a weight, from its PyTorch or Burn name."""
    head, _, last = name.rpartition(".")
    return f"{head}.{TORCH_FROM_BURN.get(last, last)}"
