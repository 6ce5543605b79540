"""One training view: noisy image, features, reference from other samples, and the noise of both."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tracer

sys.path.append(str(Path(__file__).resolve().parents[1]))

from rendered import CLAMP, GUIDES, LUMINANCE, REFERENCE_SHARE, USUAL, Unsuitable, brightness, file_channels, rel_mse

PROBE_SAMPLES = 8
"""Samples per pixel for measuring the mean."""
ROUND_SAMPLES = 16
"""Samples per pixel of one round of the reference. Rounds alternate between two halves."""
MOTION = (0.003, 0.04)
"""Shortest and longest way of a moving camera, as shares of the median distance."""
FEW, MANY = 64, 1 << 31
"""Noisy images of more samples per pixel than `FEW` use seeds from `MANY` on."""
HALVES = ("color", "normal", "albedo1", "depth")
"""Buffers that have two half buffers, `half1.NAME` and `half2.NAME`, with passes."""
PARTS = ("diffuse", "specular")
"""The parts of colour and reference."""


@dataclass
class Budget:
    """Limits of a view's samples and noise."""

    ref_samples: int
    """Largest number of samples per pixel of the reference, for noisy images of few samples."""
    residual: float
    """Expected RelMSE of the reference at which it is good enough."""
    noise: tuple[float, float] = (0.0, np.inf)
    """Smallest and largest RelMSE of a noisy image with 4 samples per pixel."""
    near: float = 0.0
    """A view is blocked if more than 30 % of its pixels are nearer than this, in scene units."""


@dataclass
class Traits:
    """What other renderers' files have."""

    pixel_filter: float = 0.0
    """Standard deviation of a Gaussian pixel filter, in pixels; 0 for a box. Its noise is correlated."""
    follow: bool = False
    """Albedo is that of the surface behind mirrors and clear glass (`tracer.render`)."""
    exposure: float = 1.0
    """Factor on colour and reference."""
    motion: tuple[float, ...] = ()
    """The way of the camera during the exposure, as shares of the median distance; empty: it rests."""

    @classmethod
    def draw(cls, rng: np.random.Generator, share: float, moving: float = 0.0) -> Traits:
        """Each trait with probability `share`, a moving camera with probability `moving`."""
        has = rng.random(3) < share
        sigma, stops = rng.uniform(0.35, 0.75), rng.uniform(-10, 10)
        motion = np.empty(0)
        if rng.random() < moving:
            way = rng.normal(size=3)
            motion = way / np.linalg.norm(way) * np.exp(rng.uniform(*np.log(MOTION)))
        return cls(float(has[0] * sigma), bool(has[1]), float(2.0 ** (has[2] * stops)), tuple(motion.tolist()))


def photograph(
    scene, view: int, seed: int, budget: Budget, counts: list[int], traits: Traits = Traits(), passes: bool = False
) -> list[tuple[dict[str, np.ndarray], dict]]:
    """For each number of samples per pixel in `counts`: channels of the EXR file, `[H, W]` each, and facts for the manifest.

    An image of more samples contains those of fewer. The reference has others. With `passes`, there are
    also half buffers, variances, depth, and the diffuse and the specular part of colour and reference.
    """
    probe = tracer.render(scene, PROBE_SAMPLES, seed, view=view)
    mean = brightness(probe.color / probe.count)
    eye = np.ravel(scene.sensors()[view].world_transform().translation())
    distance = np.linalg.norm(probe.features["position"] / probe.count - eye, axis=-1)
    if np.quantile(distance, 0.3) < budget.near:
        raise Unsuitable("blocked")
    scale, clamp = LUMINANCE / mean, CLAMP * mean
    motion = np.median(distance) * np.array(traits.motion) if traits.motion else None

    ways = {"clamp": clamp, "view": view, "follow": traits.follow, "passes": passes, "motion": motion}
    trace = partial(tracer.render, scene, **ways)

    images = noisy_images(trace, seed, scale, sorted(counts), traits.pixel_filter, passes)
    halves, count, others = [0.0, 0.0], 0, dict.fromkeys((*GUIDES, *(PARTS if passes else ())), 0.0)
    largest = max(budget.ref_samples, REFERENCE_SHARE * max(counts))
    while True:
        for half in range(2):
            start = seed + 100 + count + ROUND_SAMPLES * half
            traced = trace(ROUND_SAMPLES, start)
            halves[half] = halves[half] + traced.color / traced.count
            others = {name: total + traced.features[name] for name, total in others.items()}
        count += 2 * ROUND_SAMPLES
        rounds = count / (2 * ROUND_SAMPLES)
        a, b = (filtered(half / rounds * scale, traits.pixel_filter) for half in halves)
        reference = (a + b) / 2
        residual = rel_mse((a - b) / 2, reference)
        noises = [rel_mse(image["color"] - reference, reference) - residual for _, image in images]
        low, high = budget.noise
        first = noises[0] * images[0][0] / USUAL
        if not low < first < high:
            raise Unsuitable(f"noise {first:.1f}")
        if residual < min(budget.residual, noises[-1] / REFERENCE_SHARE) or count >= largest:
            break

    found = []
    for (samples, image), noise in zip(images, noises):
        buffers = image | {"ref.color": reference}
        for name, total in others.items():
            buffers["ref." + name] = filtered(total / count * (scale if name in PARTS else 1), traits.pixel_filter)
        for name in ("color", "ref.color"):
            buffers[name] = buffers[name] * traits.exposure
        channels = file_channels(buffers, traits.exposure != 1)
        height, width, _ = reference.shape
        facts = {
            "width": width,
            "height": height,
            "spp": samples,
            "ref_spp": count,
            "seed": seed,
            "max_depth": tracer.MAX_DEPTH,
            "exposure_scale": float(scale * traits.exposure),
            "clamp_value": CLAMP * LUMINANCE * traits.exposure,
            "noisy_relmse": noise,
            "ref_residual_relmse": residual,
            "mask_mean": float(image["mask"].mean()),
        }
        if traits != Traits():
            facts |= {"pixel_filter_sigma": traits.pixel_filter, "albedo_behind_glass": traits.follow}
        if traits.motion:
            facts["camera_motion"] = list(traits.motion)
        if passes:
            facts["passes"] = "paper"
        found.append((channels, facts))
    return found


def noisy_images(
    trace: Callable, seed: int, scale: float, counts: list[int], pixel_filter: float, passes: bool
) -> list[tuple[int, dict[str, np.ndarray]]]:
    """The number of samples per pixel and the buffers of each noisy image, `[H, W, C]` each.

    `trace` traces a number of samples from a seed; `scale` is the factor on radiance.
    """
    images, halves = [], [None] * (2 if passes else 1)
    for count in counts:
        added = (count - sum(half.count for half in halves if half)) // len(halves)
        # Seeds that neither the reference nor other views use.
        start = seed + 10 if count <= FEW and not images else seed + MANY + count
        for i, half in enumerate(halves):
            traced = trace(added, start + i * added)
            halves[i] = traced.plus(half)
        noisy = halves[0].plus(halves[1] if passes else None)
        factor = lambda name: scale if name in ("color", *PARTS) else 1.0
        buffers = {name: noisy.mean(name) * factor(name) for name in ("color", *noisy.features)}
        for name in noisy.squares:
            buffers[f"variance.{name}"] = noisy.variance(name) * factor(name) ** 2
        for i, half in enumerate(halves):
            buffers |= {f"half{i + 1}.{name}": half.mean(name) * factor(name) for name in HALVES if passes}
        images.append((count, {name: filtered(planes, pixel_filter) for name, planes in buffers.items()}))
    return images


def filtered(planes: np.ndarray, sigma: float) -> np.ndarray:
    """`[H, W, C]` filtered with a Gaussian of this standard deviation, in pixels; the border is replicated."""
    if sigma == 0:
        return planes
    offsets = np.arange(-2, 3)
    weights = np.exp(-0.5 * (offsets / sigma) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        length = planes.shape[axis]
        taken = [planes.take(np.clip(np.arange(length) + offset, 0, length - 1), axis) for offset in offsets]
        planes = sum(weight * part for weight, part in zip(weights, taken))
    return planes
