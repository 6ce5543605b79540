"""One training view: noisy image, features, reference from other samples, and the noise of both."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
import tracer

# The package of this checkout.
sys.path.append(str(Path(__file__).resolve().parents[2] / "bindings" / "python"))

from demc.torch.exr import write_whole

LUMINANCE = 0.22
"""Mean luminance after scaling, without the brightest pixels."""
TRIMMED = 0.02
"""Share of the brightest pixels that the mean excludes."""
CLAMP = 45.0
"""Upper limit of a sample, in units of that mean."""
PROBE_SAMPLES = 8
"""Samples per pixel for measuring the mean."""
PASS_SAMPLES = 16
"""Samples per pixel of one pass of the reference. Passes alternate between two halves."""
EPSILON = 0.001
"""Epsilon of RelMSE (Eq. 5)."""
USUAL = 4
"""Samples per pixel that the limits on noise are for."""
FEW, MANY = 64, 1 << 31
"""Noisy images of more samples per pixel than `FEW` use seeds from `MANY` on."""
REFERENCE_SHARE = 4
"""A reference has at least this many times the samples of the noisy image, or a residual below this part of its noise."""
CHANNELS = {"normal.": "XYZ", "position.": "XYZ", "albedo1.": "RGB", "albedo2.": "RGB", "mask.": "A"}
GUIDES = ("normal", "albedo1")
"""Features of the reference's own samples that are written, for `tools/references.py`."""


class Unsuitable(Exception):
    """The view is useless for training."""


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

    @classmethod
    def draw(cls, rng: np.random.Generator, share: float) -> Traits:
        """Each trait with probability `share`."""
        has = rng.random(3) < share
        sigma, stops = rng.uniform(0.35, 0.75), rng.uniform(-10, 10)
        return cls(float(has[0] * sigma), bool(has[1]), float(2.0 ** (has[2] * stops)))


def photograph(
    scene, view: int, seed: int, budget: Budget, counts: list[int], traits: Traits = Traits()
) -> list[tuple[dict[str, np.ndarray], dict]]:
    """For each number of samples per pixel in `counts`: channels of the EXR file, `[H, W]` each, and facts for the manifest.

    An image of more samples contains those of fewer. The reference has others.
    """
    probe = tracer.render(scene, PROBE_SAMPLES, seed, view=view)
    luminance = np.sort((probe.color / probe.count @ [0.2126, 0.7152, 0.0722]).ravel())
    mean = luminance[: int(len(luminance) * (1 - TRIMMED))].mean()
    if not mean > 1e-4:
        raise Unsuitable("dark")
    eye = np.ravel(scene.sensors()[view].world_transform().translation())
    distance = np.linalg.norm(probe.features["position"] / probe.count - eye, axis=-1)
    if np.quantile(distance, 0.3) < budget.near:
        raise Unsuitable("blocked")
    scale, clamp = LUMINANCE / mean, CLAMP * mean

    images, noisy = [], None
    for count in sorted(counts):
        added = count - (noisy.count if noisy else 0)
        # Seeds that neither the reference nor other views use.
        start = seed + 10 if count <= FEW and not noisy else seed + MANY + count
        noisy = tracer.render(scene, added, start, clamp, view, traits.follow).plus(noisy)
        means = {name: planes / count for name, planes in {"color": noisy.color * scale, **noisy.features}.items()}
        images.append((count, {name: filtered(planes, traits.pixel_filter) for name, planes in means.items()}))

    halves, count, guides = [0.0, 0.0], 0, dict.fromkeys(GUIDES, 0.0)
    largest = max(budget.ref_samples, REFERENCE_SHARE * max(counts))
    while True:
        for half in range(2):
            start = seed + 100 + count + PASS_SAMPLES * half
            traced = tracer.render(scene, PASS_SAMPLES, start, clamp, view, traits.follow)
            halves[half] = halves[half] + traced.color / traced.count
            guides = {name: total + traced.features[name] for name, total in guides.items()}
        count += 2 * PASS_SAMPLES
        passes = count / (2 * PASS_SAMPLES)
        a, b = (filtered(half / passes * scale, traits.pixel_filter) for half in halves)
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
        buffers = {"": ("RGB", image["color"] * traits.exposure), "ref.": ("RGB", reference * traits.exposure)}
        for (prefix, names), name in zip(CHANNELS.items(), tracer.FEATURES):
            buffers[prefix] = (names, image[name])
            if name in GUIDES:
                buffers["ref." + prefix] = (names, filtered(guides[name] / count, traits.pixel_filter))
        channels = {}
        for prefix, (names, planes) in buffers.items():
            coarse = prefix == "position." and too_coarse(planes) or prefix in ("", "ref.") and traits.exposure != 1
            kind = np.float32 if coarse else np.float16
            limit = np.finfo(kind).max
            for i, name in enumerate(names):
                channels[prefix + name] = np.ascontiguousarray(planes[..., i].clip(-limit, limit).astype(kind))
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
        found.append((channels, facts))
    return found


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


def rel_mse(difference: np.ndarray, reference: np.ndarray) -> float:
    """Eq. 5, summed over rgb."""
    return float((difference**2 / (reference**2 + EPSILON)).mean() * 3)


def too_coarse(position: np.ndarray) -> bool:
    """Whether the step of a 16-bit float exceeds a thousandth of the visible extent."""
    step = float(np.spacing(np.float16(min(np.abs(position).max(), 6e4))))
    return np.abs(position).max() > 6e4 or step > np.ptp(position, axis=(0, 1)).max() / 1000


def write(path: Path, channels: dict[str, np.ndarray], entry: dict) -> None:
    """Writes the EXR file completely or not at all. Its header contains the manifest's entry."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "demc": json.dumps(entry)}
    write_whole(path, OpenEXR.File(header, channels))


def entry_of(path: Path) -> dict:
    """The manifest's entry in a file's header."""
    with OpenEXR.File(str(path), header_only=True) as file:
        return json.loads(file.header()["demc"])
