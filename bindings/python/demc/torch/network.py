"""DEMC, DEMCnoSN, SEMC and color-only as PyTorch modules, in both readings of the paper.

Tensors are NCHW. Level i = 1..5 of an encoder has ``width * levels[i - 1]`` channels; `levels` is
(1, 2, 4, 8, 8) in the paper. The levels have 1, 1/2, 1/4, 1/8 and 1/16 of the input's resolution,
the latent 1/32. So heights and widths must be multiples of 32.

Attribute names are the keys of the weight files: renaming one breaks them. Section, equation and
figure numbers are the paper's.
"""

from __future__ import annotations

import math
from typing import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .config import READINGS, VARIANTS, ModelConfig, Reading
from .preprocess import FEATURES

BN_EPSILON = 1e-3
"""TensorFlow's default, which the authors' code uses."""
BN_MOMENTUM = 0.01
"""Share of the new batch in the running statistics: TensorFlow's momentum 0.99."""
OPEN_BIAS = 1.0
"""Initial bias of the detail map's last convolution if `detail` is "open" (ours)."""
GREY_HEAD_SCALE = 0.1
"""Factor of the head's Xavier weights if `head` is "grey" or "kernel" (ours)."""
KERNEL_LEVELS = 4
"""Levels at which a kernel head filters, from the full resolution down."""
KERNEL_TAPS = 25
"""Weights of a 5x5 kernel."""
KERNEL_GAMMA = 2.2
"""Exponent of the colour compression that a kernel head undoes."""
DARKEST = 1e-8
"""Smaller outputs of a kernel head, in linear light, count as black."""
CHANNELS = {"detail": 3, "color": 3, "features": FEATURES}


class BatchNorm(nn.Module):
    """Batch normalisation with the conventions of the Rust code.

    Unlike ``nn.BatchNorm2d``, the running variance averages the *biased* batch variance, as Burn
    0.22 and TensorFlow's non-fused operation do. PyTorch and TensorFlow's fused operation multiply
    it by N/(N-1). There is no ``num_batches_tracked``.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        if not self.training:
            return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, eps=BN_EPSILON)
        with torch.no_grad():
            self.running_mean.lerp_(x.mean((0, 2, 3)), BN_MOMENTUM)
            self.running_var.lerp_(x.var((0, 2, 3), correction=0), BN_MOMENTUM)
        return F.batch_norm(x, None, None, self.weight, self.bias, training=True, eps=BN_EPSILON)


def conv3x3(in_channels: int, out_channels: int) -> nn.Conv2d:
    """A 3x3 convolution that keeps the size."""
    return nn.Conv2d(in_channels, out_channels, 3, padding=1)


class FusionBlock(nn.Module):
    """conv3x3, BatchNorm if `norm`, ReLU."""

    def __init__(self, in_channels: int, out_channels: int, norm: bool) -> None:
        super().__init__()
        self.conv = conv3x3(in_channels, out_channels)
        self.norm = BatchNorm(out_channels) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        return F.relu(x if self.norm is None else self.norm(x))


class Fusion(nn.Module):
    """The feature fusion sub-network (Sec. 3.2).

    [B, 12, H, W] Z-scored features -> [B, 3, H, W] detail map.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        widths = (FEATURES, width, width, width, 3)
        norms = (False, True, True, False)
        self.blocks = nn.ModuleList(FusionBlock(a, b, n) for a, b, n in zip(widths, widths[1:], norms))

    def forward(self, features_z: Tensor) -> Tensor:
        for block in self.blocks:
            features_z = block(features_z)
        return features_z


class EncoderLevel(nn.Module):
    """Convolutions with ReLU, and a max-pool after the last one if `pooled`.

    The skip is the output of convolution number `skip_after`.
    """

    def __init__(self, in_channels: int, channels: int, convs: int, skip_after: int, pooled: bool) -> None:
        super().__init__()
        self.skip_after, self.pooled = skip_after, pooled
        self.convs = nn.ModuleList(conv3x3(in_channels if j == 0 else channels, channels) for j in range(convs))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """[B, C, H, W] -> the skip [B, K, H, W] and the next level's input [B, K, H/2, W/2]."""
        for j, conv in enumerate(self.convs):
            x = F.relu(conv(x))
            if j + 1 == self.skip_after:
                skip = x
        return skip, F.max_pool2d(x, 2) if self.pooled else None


class Encoder(nn.Module):
    """Five levels. Without `feeds_latent`, the last level ends at its skip."""

    def __init__(self, in_channels: int, levels: Sequence[int], reading: Reading, feeds_latent: bool) -> None:
        super().__init__()
        self.levels = nn.ModuleList()
        for i, (convs, skip_after) in enumerate(zip(reading.convs, reading.skip_after)):
            channels = levels[i]
            pooled = feeds_latent or i + 1 < len(levels)
            self.levels.append(EncoderLevel(in_channels, channels, convs if pooled else skip_after, skip_after, pooled))
            in_channels = channels

    def forward(self, x: Tensor) -> tuple[list[Tensor], Tensor | None]:
        """[B, C, H, W] -> the five skips, full resolution first, and the latent's input.

        The latent's input is [B, K, H/32, W/32]; K is the number of channels of the last level.
        """
        skips = []
        for level in self.levels:
            skip, x = level(x)
            skips.append(skip)
        return skips, x


class Latent(nn.Module):
    """conv3x3, BatchNorm in the released reading, ReLU: [B, K, h, w] -> [B, K, h, w]."""

    def __init__(self, channels: int, reading: Reading) -> None:
        super().__init__()
        self.conv = conv3x3(channels, channels)
        self.norm = BatchNorm(channels) if reading.norm else None

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        return F.relu(x if self.norm is None else self.norm(x))


class DecoderLevel(nn.Module):
    """Deconvolution to twice the size, then a 1x1 convolution of ``[decoder | feature skip | HDR skip]``.

    Eq. 2 of the paper.
    """

    def __init__(self, in_channels: int, channels: int, skips: int, reading: Reading) -> None:
        super().__init__()
        self.fuse_relu = reading.fuse_relu
        self.deconv = nn.ConvTranspose2d(in_channels, channels, 4, stride=2, padding=1)
        self.norm = BatchNorm(channels) if reading.norm else None
        self.fuse = nn.Conv2d(channels * (1 + skips), channels, 1)

    def forward(self, x: Tensor, skips: Sequence[Tensor]) -> Tensor:
        """[B, Kin, h, w] and skips of [B, K, 2h, 2w] -> [B, K, 2h, 2w]."""
        x = self.deconv(x)
        x = F.relu(x if self.norm is None else self.norm(x))
        x = self.fuse(torch.cat([x, *skips], 1))
        return F.relu(x) if self.fuse_relu else x


class Decoder(nn.Module):
    """Five levels, the deepest first, and the head: a convolution to 3 channels and ReLU, or `kernel_head`."""

    def __init__(self, levels: Sequence[int], encoders: int, reading: Reading, head: str) -> None:
        super().__init__()
        widths = [levels[-1], *reversed(levels)]
        self.levels = nn.ModuleList(DecoderLevel(a, b, encoders, reading) for a, b in zip(widths, widths[1:]))
        self.head, self.kernels = None, nn.ModuleList()
        if head == "kernel":
            self.kernels = kernel_convolutions(levels)
        else:
            self.head = nn.Conv2d(levels[0], 3, reading.head_kernel, padding="same")

    def forward(
        self, latent: Tensor, skips: Sequence[Sequence[Tensor]], color_gamma: Tensor, layers: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """The latent, and the five skips of each encoder, full resolution first -> [B, 3, H, W], >= 0.

        A kernel head also filters `layers`.
        """
        decoded = []
        for level, level_skips in zip(self.levels, reversed(list(zip(*skips)))):
            latent = level(latent, level_skips)
            decoded.append(latent)
        if self.head is not None:
            return F.relu(self.head(latent)), None
        logits = [conv(x) for conv, x in zip(self.kernels, decoded[-KERNEL_LEVELS:])]
        return kernel_head(logits, color_gamma, layers)


def kernel_convolutions(channels: Sequence[int]) -> nn.ModuleList:
    """The convolutions to logits, the deepest first; `channels` of the maps, from the full resolution down."""
    levels = reversed(range(KERNEL_LEVELS))
    return nn.ModuleList(nn.Conv2d(channels[i], KERNEL_TAPS + (i + 1 < KERNEL_LEVELS), 1) for i in levels)


def kernel_head(
    logits: Sequence[Tensor], color_gamma: Tensor, layers: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """Filters the noisy colour with predicted kernels on four scales (Bako et al. 2017, Vogels et al. 2018).

    `logits` are [B, 25, H/8, W/8], then [B, 26, H/4, W/4] to [B, 26, H, W]: a 5x5 kernel, and the weight with which the
    level below replaces low frequencies. Colour and output are [B, 3, H, W] in gamma space. For B = 1, the same kernels
    filter `layers`, [L, 3, H, W] in linear light.
    """
    color = color_gamma.detach().clamp_min(0) ** KERNEL_GAMMA
    out = filtered_on_all_scales(logits, color if layers is None else torch.cat((color, layers)))
    out, others = out.split((len(color), len(out) - len(color)))
    denoised = out.clamp_min(DARKEST) ** (1 / KERNEL_GAMMA) * (out > DARKEST)
    return denoised, None if layers is None else others


def filtered_on_all_scales(logits: Sequence[Tensor], images: Tensor) -> Tensor:
    """Images [B, 3, H, W] in linear light, filtered with the kernels of `kernel_head`."""
    images = [images]
    for _ in logits[1:]:
        images.append(F.avg_pool2d(images[-1], 2))
    out = None
    for level_logits, image in zip(logits, reversed(images)):
        fine = filtered(image, level_logits[:, :KERNEL_TAPS].softmax(1))
        if out is not None:
            correction = F.interpolate(out - F.avg_pool2d(fine, 2), scale_factor=2, mode="bilinear")
            fine = fine + level_logits[:, KERNEL_TAPS:].sigmoid() * correction
        out = fine
    return out


def filtered(image: Tensor, kernels: Tensor) -> Tensor:
    """The mean of each pixel's neighbours with its own weights [B, side^2, H, W]; the border is replicated."""
    height, width = image.shape[-2:]
    side = math.isqrt(kernels.shape[1])
    padded = F.pad(image, [side // 2] * 4, mode="replicate")
    windows = (padded[..., y : y + height, x : x + width] for y in range(side) for x in range(side))
    return sum(window * kernels[:, i : i + 1] for i, window in enumerate(windows))


class Denoiser(nn.Module):
    """The whole network, with the initialisation of a training run (Sec. 4.2)."""

    def __init__(self, config: ModelConfig = ModelConfig(), head_bias: Sequence[float] = (0.3, 0.3, 0.3)) -> None:
        """`head_bias` is the initial bias of a grey head.

        A training run uses the flat colour with the least RelMSE on its training set, in gamma
        space.
        """
        super().__init__()
        self.config = config
        self.variant = VARIANTS[config.variant]
        reading, levels = READINGS[config.reading], config.level_channels
        self.fusion = Fusion(config.width) if self.variant.fusion else None
        last = len(self.variant.encoders) - 1
        self.encoders = nn.ModuleList(
            Encoder(sum(CHANNELS[name] for name in inputs), levels, reading, feeds_latent=e == last)
            for e, inputs in enumerate(self.variant.encoders)
        )
        self.latent = Latent(levels[-1], reading)
        self.decoder = Decoder(levels, last + 1, reading, config.head)
        self._initialise(head_bias)

    def forward(self, color_gamma: Tensor, features_z: Tensor) -> Tensor:
        """Gamma-space colour [B, 3, H, W] and Z-scored features [B, 12, H, W] -> [B, 3, H, W].

        The output is in gamma space and not negative.
        """
        return self._run(color_gamma, features_z, None)[0]

    def forward_with_layers(self, color_gamma: Tensor, features_z: Tensor, layers: Tensor) -> tuple[Tensor, Tensor]:
        """As `forward`, for one image; the kernels of a kernel head also filter `layers`.

        `layers` are [L, 3, H, W] in linear light, of either sign. Raises ValueError for another head
        or several images.
        """
        if self.decoder.head is not None:
            raise ValueError(f'layers need a model with head "kernel"; this one has "{self.config.head}"')
        if len(color_gamma) != 1:
            raise ValueError(f"layers need one image, not {len(color_gamma)}")
        return self._run(color_gamma, features_z, layers)

    def _run(
        self, color_gamma: Tensor, features_z: Tensor, layers: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        planes = {"color": color_gamma, "features": features_z}
        if self.fusion is not None:
            planes["detail"] = self.fusion(features_z)
        skips = []
        for encoder, names in zip(self.encoders, self.variant.encoders):
            encoder_skips, pooled = encoder(torch.cat([planes[name] for name in names], 1))
            skips.append(encoder_skips)
        return self.decoder(self.latent(pooled), skips, color_gamma, layers)

    def detail_map(self, features_z: Tensor) -> Tensor | None:
        """[B, 12, H, W] -> [B, 3, H, W] (Fig. 2 e); None if the variant has no fusion sub-network."""
        return None if self.fusion is None else self.fusion(features_z)

    @torch.no_grad()
    def _initialise(self, head_bias: Sequence[float]) -> None:
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
                nn.init.zeros_(module.bias)
            if isinstance(module, nn.ConvTranspose2d):
                module.weight.copy_(bilinear_kernel(*module.weight.shape[:2]))
            elif isinstance(module, nn.Conv2d):
                nn.init.xavier_uniform_(module.weight)
        for level in self.decoder.levels:
            channels, inputs = level.fuse.weight.shape[:2]
            level.fuse.weight.copy_(torch.eye(channels).repeat(1, inputs // channels)[:, :, None, None])
        for conv in self.decoder.kernels:
            conv.weight.mul_(GREY_HEAD_SCALE)
        if self.config.head == "grey":
            self.decoder.head.weight.mul_(GREY_HEAD_SCALE)
            self.decoder.head.bias.copy_(torch.tensor(head_bias))
        if self.fusion is not None and self.config.detail == "open":
            self.fusion.blocks[-1].conv.bias.fill_(OPEN_BIAS)


def bilinear_kernel(in_channels: int, out_channels: int) -> Tensor:
    """Weight [in, out, 4, 4] of a deconvolution that upsamples each channel bilinearly (Sec. 4.2)."""
    line = torch.tensor([0.25, 0.75, 0.75, 0.25])
    return torch.eye(in_channels, out_channels)[:, :, None, None] * torch.outer(line, line)
