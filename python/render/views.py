"""One training view: noisy image, features, reference from other samples, and the noise of both."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
import tracer

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
CHANNELS = {"normal.": "XYZ", "position.": "XYZ", "albedo1.": "RGB", "albedo2.": "RGB", "mask.": "A"}
GUIDES = ("normal", "albedo1")
"""Features of the reference's own samples that are written, for `tools/references.py`."""


class Unsuitable(Exception):
    """The view is useless for training."""


@dataclass
class Budget:
    """Limits of a view's samples and noise."""

    samples: int
    """Samples per pixel of the noisy image."""
    ref_samples: int
    """Largest number of samples per pixel of the reference."""
    residual: float
    """Expected RelMSE of the reference at which it is good enough."""
    noise: tuple[float, float] = (0.0, np.inf)
    """Smallest and largest RelMSE of the noisy image."""
    near: float = 0.0
    """A view is blocked if more than 30 % of its pixels are nearer than this, in scene units."""


def photograph(scene, view: int, seed: int, budget: Budget) -> tuple[dict[str, np.ndarray], dict]:
    """Channels of the EXR file, `[H, W]` each, and facts for the manifest."""
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

    noisy = tracer.render(scene, budget.samples, seed + 10, clamp, view)
    color = noisy.color / noisy.count * scale
    halves, count, guides = [0.0, 0.0], 0, dict.fromkeys(GUIDES, 0.0)
    while True:
        for half in range(2):
            traced = tracer.render(scene, PASS_SAMPLES, seed + 100 + count + PASS_SAMPLES * half, clamp, view)
            halves[half] = halves[half] + traced.color / traced.count
            guides = {name: total + traced.features[name] for name, total in guides.items()}
        count += 2 * PASS_SAMPLES
        a, b = (half / (count / (2 * PASS_SAMPLES)) * scale for half in halves)
        reference = (a + b) / 2
        residual = rel_mse((a - b) / 2, reference)
        noise = rel_mse(color - reference, reference) - residual
        if not budget.noise[0] < noise < budget.noise[1]:
            raise Unsuitable(f"noise {noise:.1f}")
        if residual < budget.residual or count >= budget.ref_samples:
            break

    buffers = {"": ("RGB", color), "ref.": ("RGB", reference)}
    for (prefix, names), name in zip(CHANNELS.items(), tracer.FEATURES):
        buffers[prefix] = (names, noisy.features[name] / noisy.count)
        if name in GUIDES:
            buffers["ref." + prefix] = (names, guides[name] / count)
    channels = {}
    for prefix, (names, planes) in buffers.items():
        kind = np.float32 if prefix == "position." and too_coarse(planes) else np.float16
        limit = np.finfo(kind).max
        for i, name in enumerate(names):
            channels[prefix + name] = np.ascontiguousarray(planes[..., i].clip(-limit, limit).astype(kind))
    height, width, _ = color.shape
    facts = {
        "width": width,
        "height": height,
        "spp": noisy.count,
        "ref_spp": count,
        "seed": seed,
        "max_depth": tracer.MAX_DEPTH,
        "exposure_scale": float(scale),
        "clamp_value": CLAMP * LUMINANCE,
        "noisy_relmse": noise,
        "ref_residual_relmse": residual,
        "mask_mean": float(noisy.features["mask"].mean() / noisy.count),
    }
    return channels, facts


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
    unfinished = path.with_name(f".{path.name}.unfinished")
    OpenEXR.File(header, channels).write(str(unfinished))
    os.replace(unfinished, path)


def entry_of(path: Path) -> dict:
    """The manifest's entry in a file's header."""
    with OpenEXR.File(str(path), header_only=True) as file:
        return json.loads(file.header()["demc"])
