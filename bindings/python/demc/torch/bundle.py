"""Bundles: safetensors files that `demc-infer export` writes, and denoising with them.

The header's key ``demc`` contains JSON: the model's configuration, the feature statistics of the
training set, the names of the renderer's channels, and the training step. A bundle may contain a
second network, which denoises the albedo first: its entry is ``albedo_filter``, and so its tensors'
prefix.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional as F

from . import light, preprocess, transfer
from .config import KPCN, UNETS, ModelConfig
from .kpcn import Kpcn
from .layers import layer_color, layer_images, scaled
from .metrics import gamma_from_hdr
from .network import Denoiser
from .preprocess import FEATURES
from .unet import Unet

FORMAT = 1
"""The bundle format that this package reads."""
MAX_ALBEDO = 1.0
"""Larger albedo counts as this."""
FILTER = "albedo_filter"
"""Key of the albedo filter's entry in the header."""
PREFIX = f"{FILTER}."
"""Prefix of its tensors."""
DTYPES = {torch.float32: "F32", torch.float16: "F16"}
"""Types of tensors and their names in a checksum."""
CHECKSUM = "sha256"
"""The header's key with the checksum of header and tensors."""
TORCH_FROM_BURN = {"gamma": "weight", "beta": "bias"}
"""Last part of a batch-normalisation key: Burn's name to PyTorch's."""


@dataclass
class Bundle:
    """A network in eval mode and the statistics of its training set."""

    model: Denoiser | Kpcn | Unet
    gamma: float
    feature_mean: Tensor  # [12]
    feature_std: Tensor  # [12]
    step: int
    meta: dict  # the whole header, without the checksum: who saves other weights needs none
    demodulate: float = 0.0  # epsilon of albedo demodulation; 0: off
    albedo_filter: Bundle | None = None  # denoises the albedo (first hit) before the network sees it

    def input_scale(self, color_hdr: np.ndarray) -> float:
        """The factor on colour [3, H, W] before the network (`preprocess.input_scale`)."""
        return preprocess.input_scale(color_hdr, self.meta)

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
        normals, positions, albedo = features.split((3, 3, 6), 1)
        albedo = albedo.clamp_max(MAX_ALBEDO)
        if self.meta["normalizer"].get("transfer") == "pu":
            normals, albedo = normals.clamp(-1, 1), albedo.clamp_min(0)
        features = torch.cat((normals, positions, albedo), 1)
        return (features - self.feature_mean.view(shape)) / self.feature_std.view(shape)

    def radiance(self, color: Tensor, features: Tensor) -> Tensor:
        """The network between linear radiances, as the ONNX graph has it; differentiable.

        Prepared colour [B, 3, H, W] and features [B, 12, H, W] (`preprocess.prepare`) -> [B, 3, H, W].
        Height and width are multiples of 32, or of 16 for variant `unet`. An albedo filter runs first.
        """
        return self._radiance(color, self.with_filtered_albedo(features))

    @property
    def filters_layers(self) -> bool:
        """Whether the colour's kernels filter layers: whether the model has a kernel head."""
        return self.model.config.head == "kernel"

    def radiance_with_layers(
        self, color: Tensor, features: Tensor, layers: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """As `radiance`, for one image; a kernel head filters `layers` [H, W] with the colour's kernels.

        A layer whose name ends in R, G, or B is divided by that channel of the albedo as the colour
        is. Other layers, such as alpha, are not. Layers are neither scaled nor clamped.
        """
        if not self.filters_layers:
            raise ValueError(f'this method needs a model with head "kernel"; this one is {self.model.config}')
        inputs, modulation = self._inputs(color, self.with_filtered_albedo(features))
        albedo = torch.cat((modulation[0] ** self.gamma, torch.ones_like(modulation[0, :1])))
        albedo = albedo[[layer_color(name) for name in layers]]
        planes = torch.stack(list(layers.values())) / albedo
        images = F.pad(planes, (0, 0, 0, 0, 0, -len(planes) % 3)).unflatten(0, (-1, 3))
        out, filtered = self.model.forward_with_layers(*inputs, images)
        filtered = filtered.flatten(0, 1)[: len(planes)] * albedo
        return transfer.expand(out * modulation, self.meta["normalizer"]), dict(zip(layers, filtered))

    def _radiance(self, color: Tensor, features: Tensor, demodulates: bool = True) -> Tensor:
        """As `radiance`, for features with filtered albedo."""
        inputs, modulation = self._inputs(color, features, demodulates)
        return transfer.expand(self.model(*inputs) * modulation, self.meta["normalizer"])

    def _inputs(
        self, color: Tensor, features: Tensor, demodulates: bool = True
    ) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """The network's inputs for prepared colour and filtered features, and the modulation of its output."""
        if isinstance(self.model, Kpcn):
            raise ValueError("kpcn takes diffuse and specular light: call `model` with them, or use demc-infer")
        modulation = self.modulation(features)
        if not demodulates:
            modulation = torch.ones_like(modulation)
        compressed = transfer.compress(color, self.meta["normalizer"]) / modulation
        return (compressed, self.features_z_from_raw(features)), modulation

    def with_filtered_albedo(self, features: Tensor) -> Tensor:
        """Prepared features [B, 12, H, W] with the albedo (first hit) that the network sees.

        An image of constant albedo, pixels with albedo 0, and a bundle without a filter keep theirs.
        """
        if self.albedo_filter is None:
            return features
        noisy = features[:, 6:9]
        filtered = self.albedo_filter.radiance(noisy.clamp(0, MAX_ALBEDO), features).clamp(0, MAX_ALBEDO)
        filtered = filtered * (noisy > 0).any(1, True)
        varies = (noisy.amax((2, 3), True) > noisy.amin((2, 3), True)).any(1, True)
        return torch.cat((features[:, :6], torch.where(varies, filtered, noisy), features[:, 9:]), 1)

    @torch.inference_mode()
    def filtered_albedo(self, color_hdr: np.ndarray, features: np.ndarray) -> np.ndarray:
        """The albedo (first hit) that the network sees for one image of any size.

        Arguments as for `denoise`; returns [3, H, W], 0 to 1.
        """
        _, feats, _ = preprocess.prepare(color_hdr, features, self.meta)
        height, width = feats.shape[-2:]
        found = self.with_filtered_albedo(self._padded(feats)[None])[0, 6:9, :height, :width]
        return found.clamp(0, MAX_ALBEDO).cpu().numpy()

    def tensors(self) -> dict[str, Tensor]:
        """All weights by their PyTorch names, to save them with `meta`; includes the albedo filter."""
        weights = {name: weight.cpu().contiguous() for name, weight in self.model.state_dict().items()}
        if self.albedo_filter is not None:
            weights |= {PREFIX + name: weight for name, weight in self.albedo_filter.tensors().items()}
        return weights

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
        _, feats, scale = preprocess.prepare(color_hdr, features, self.meta, input_scale)
        return self._denoised(color_hdr, self._prepared(feats), scale)

    @torch.inference_mode()
    def denoise_with_layers(
        self,
        color_hdr: np.ndarray,
        features: np.ndarray,
        layers: Mapping[str, np.ndarray],
        input_scale: float | None = None,
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """As `denoise`, with further channels [H, W] by name, as `demc-infer denoise --layers` denoises them.

        A kernel head filters them with the kernels of the colour. Other networks denoise each as an image
        of its own (`layers`). Layers that add up to the colour still do. Returns the colour and the layers.
        Raises ValueError for KPCN.
        """
        if not layers:
            return self.denoise(color_hdr, features, input_scale), {}
        if isinstance(self.model, Kpcn):
            raise ValueError("a kpcn model denoises no layers: it takes diffuse and specular light, not images")
        color, feats, scale = preprocess.prepare(color_hdr, features, self.meta, input_scale)
        height, width = color.shape[-2:]
        for name, plane in layers.items():
            if plane.shape != (height, width):
                raise ValueError(f"layer {name} is {list(plane.shape)}: expected [{height}, {width}]")
            if not np.isfinite(plane).all():
                raise ValueError(f"layer {name} contains NaN or infinite values")
        if not self.filters_layers:
            feats = self._prepared(feats)
            image = self._denoised(color_hdr, feats, scale)
            return image, scaled(self._layer_images(feats, layers), layers, color_hdr, image)
        planes = self._padded(np.stack([np.float32(plane) for plane in layers.values()]))
        out, filtered = self.radiance_with_layers(
            self._padded(color)[None], self._padded(feats)[None], dict(zip(layers, planes))
        )
        image = out[0, :, :height, :width].cpu().numpy() / scale
        factors = light.factors(color_hdr, image, self.meta)
        factors_by_color = (*factors, 1)  # None for alpha.
        filtered = {
            name: plane[:height, :width].cpu().numpy() * factors_by_color[layer_color(name)]
            for name, plane in filtered.items()
        }
        return image * factors, filtered

    def _layer_images(self, features: Tensor, layers: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Each layer as the network denoises it as an image of its own; for features of `_prepared`."""
        denoised = {}
        for names in layer_images(layers):
            noisy = np.stack([np.float32(layers[names[i % len(names)]]) for i in range(3)])
            is_color = len(names) == 3
            if not is_color and noisy.min() == noisy.max():
                denoised[names[0]] = noisy[0]
                continue
            planes = self._denoised(noisy, features, np.float32(self.input_scale(noisy)), is_color)
            denoised |= dict(zip(names, planes if is_color else planes.mean(0, keepdims=True)))
        return {name: denoised[name] for name in layers}

    def _denoised(
        self, color_hdr: np.ndarray, features: Tensor, scale: np.float32, demodulates: bool = True
    ) -> np.ndarray:
        """An image [3, H, W] with its light, denoised with features of `_prepared`."""
        height, width = color_hdr.shape[-2:]
        color = self._padded(np.float32(color_hdr) * scale)[None]
        out = self._radiance(color, features, demodulates)
        image = out[0, :, :height, :width].cpu().numpy() / scale
        return image * light.factors(color_hdr, image, self.meta)

    def _prepared(self, features: np.ndarray) -> Tensor:
        """Features of `preprocess.prepare` as a padded batch with filtered albedo."""
        return self.with_filtered_albedo(self._padded(features)[None])

    def _padded(self, planes: np.ndarray) -> Tensor:
        """Colour, features, or layers [C, H, W] on the network's device, padded as the network needs."""
        return torch.from_numpy(preprocess.pad(planes, self.meta)).to(next(self.model.parameters()).device)

    def to(self, device: torch.device | str) -> Bundle:
        """Moves the networks and the statistics to `device`, in place."""
        self.model.to(device)
        self.feature_mean, self.feature_std = self.feature_mean.to(device), self.feature_std.to(device)
        if self.albedo_filter is not None:
            self.albedo_filter.to(device)
        return self


def load(path: str | os.PathLike) -> Bundle:
    """Reads a bundle with Burn's or PyTorch's tensor names, in f32 or f16; f16 becomes f32.

    Raises OSError if the file cannot be read. Raises ValueError if it is not a bundle of this
    format, if its tensors do not match the network in its header, or if the content differs from
    the checksum in the header. A file without a checksum loads.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = (file.metadata() or {}).get("demc")
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise ValueError(f"{path}: truncated, damaged, or not a safetensors file: {error}") from error
    if header is None:
        raise ValueError(f"{path}: no key 'demc' in the header: not written by demc-infer export")
    try:
        meta = json.loads(header)
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: header entry 'demc': not JSON: {error}") from error

    found = meta.pop(CHECKSUM, None) if isinstance(meta, dict) else None
    if found is not None and found != checksum(header.replace(found, "", 1), tensors):
        raise ValueError(f"{path}: damaged: its checksum differs; edited weights need demc-infer import")
    weights = {torch_name_from(name): tensor.float() for name, tensor in tensors.items()}
    if not isinstance(meta, dict) or FILTER not in meta:
        return _network(path, meta, weights)
    ours = {name: weight for name, weight in weights.items() if not name.startswith(PREFIX)}
    theirs = {name.removeprefix(PREFIX): weight for name, weight in weights.items() if name not in ours}
    bundle = _network(path, meta, ours)
    bundle.albedo_filter = _network(path, meta[FILTER], theirs, FILTER)
    spaces = [header["normalizer"].get("position", "scene") for header in (meta, meta[FILTER])]
    if spaces[0] != spaces[1] and meta[FILTER]["model"]["variant"] != "color-only":
        raise ValueError(f"{path}: the albedo filter takes other positions than the network")
    return bundle


def _network(path: str | os.PathLike, meta: Any, weights: dict[str, Tensor], *parents: str) -> Bundle:
    """The network that the header `meta` describes. Messages put `parents` before its keys."""

    def entry(*keys: str) -> Any:
        value = meta
        for depth, key in enumerate(keys, 1):
            if not isinstance(value, dict) or key not in value:
                raise ValueError(f"{path}: header entry 'demc': no key {'.'.join((*parents, *keys[:depth]))}")
            value = value[key]
        return value

    if (found := entry("format")) != FORMAT:
        raise ValueError(f"{path}: bundle format {found}: this package reads format {FORMAT}")
    gamma, step = entry("normalizer", "gamma"), entry("step")
    demodulate = meta["normalizer"].get("demodulate", 0.0)
    mean, std = (torch.tensor(entry("normalizer", "features", key)) for key in ("mean", "std"))
    config = ModelConfig(**entry("model"))
    model = ({KPCN: Kpcn} | dict.fromkeys(UNETS, Unet)).get(config.variant, Denoiser)(config)
    try:
        model.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        raise ValueError(f"{path}: {' '.join((*parents, *str(error).split()))}") from error
    return Bundle(
        model=model.eval(),
        gamma=gamma,
        feature_mean=mean,
        feature_std=std,
        step=step,
        meta=meta,
        demodulate=demodulate,
    )


def checksum(header: str, tensors: dict[str, Tensor]) -> str:
    """The SHA-256 of a header entry with an empty checksum, and of tensors in the order of their names."""
    digest = hashlib.sha256(header.encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {DTYPES.get(tensor.dtype)} {list(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def torch_name_from(name: str) -> str:
    """The PyTorch name of a weight, from its PyTorch or Burn name."""
    head, _, last = name.rpartition(".")
    return f"{head}.{TORCH_FROM_BURN.get(last, last)}"
