"""One view of Cycles: noisy images, features, and a reference from other samples."""

from __future__ import annotations

import contextlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import OpenEXR
from rendered import CLAMP, GUIDES, LUMINANCE, REFERENCE_SHARE, USUAL, Unsuitable, brightness, file_channels, rel_mse
from shading import Rng

PROBE_SAMPLES = 8
"""Samples per pixel for measuring the mean."""
FIRST_HALF = 16
"""Samples per pixel of each half of the reference, at first."""
BUFFERS = {"color": "Combined.RGB", "normal": "Normal.XYZ", "position": "Position.XYZ", "albedo1": "Denoising Albedo.RGB"}
"""The pass and the channels of each buffer."""
FILTERS = {"BOX": 1.0, "BLACKMAN_HARRIS": 1.5, "GAUSSIAN": 1.5}
"""Pixel filters and their usual widths, in pixels."""


@dataclass
class Settings:
    """How a view is sampled."""

    pixel_filter: str
    threshold: float
    """Noise threshold of adaptive sampling; 0: every pixel has all samples."""

    @classmethod
    def draw(cls, rng: Rng, adaptive: float) -> Settings:
        """Adaptive sampling with probability `adaptive`."""
        kind, threshold = str(rng.choice([*FILTERS])), float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
        return cls(kind, threshold if rng.random() < adaptive else 0.0)


def prepare(scene: bpy.types.Scene, size: int, settings: Settings) -> None:
    """Sets up Cycles and the passes."""
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.use_denoising, cycles.max_bounces, cycles.volume_bounces = False, 12, 4
    # The unbiased way takes half a minute before it starts.
    cycles.volume_biased = True
    cycles.pixel_filter_type, cycles.filter_width = settings.pixel_filter, FILTERS[settings.pixel_filter]
    cycles.sample_clamp_indirect = 0.0
    render = scene.render
    render.resolution_x = render.resolution_y = size
    render.resolution_percentage, render.use_persistent_data = 100, True
    image = render.image_settings
    image.media_type, image.file_format = "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER"
    image.color_depth, image.exr_codec = "32", "ZIP"
    render.use_file_extension = False
    layer = scene.view_layers[0]
    layer.use_pass_normal = layer.use_pass_position = layer.cycles.denoising_store_passes = True


def trace(scene: bpy.types.Scene, samples: int, seed: int, threshold: float = 0.0) -> dict[str, np.ndarray]:
    """Renders `samples` per pixel and returns `BUFFERS`, `[H, W, 3]` float64 each."""
    cycles = scene.cycles
    cycles.samples, cycles.seed = samples, seed % (1 << 31)
    cycles.use_adaptive_sampling = threshold > 0
    cycles.adaptive_threshold, cycles.adaptive_min_samples = threshold, max(1, samples // 8)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "view.exr")
        scene.render.filepath = path
        with quiet():
            bpy.ops.render.render(write_still=True)
        with OpenEXR.File(path, separate_channels=True) as file:
            planes = {name: channel.pixels for part in range(len(file.parts)) for name, channel in file.channels(part).items()}
    found = {}
    for buffer, name in BUFFERS.items():
        start, _, ends = name.rpartition(".")
        found[buffer] = np.stack([planes[f"ViewLayer.{start}.{end}"] for end in ends], -1).astype(np.float64)
        if not np.isfinite(found[buffer]).all():
            raise Unsuitable(f"{buffer} is not finite")
    return found


@contextlib.contextmanager
def quiet():
    """Hides what Blender prints about each frame."""
    kept, nothing = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nothing)


def photograph(
    scene: bpy.types.Scene, seed: int, counts: list[int], settings: Settings, ref_spp: int, residual: float, noise: tuple[float, float]
) -> list[tuple[dict[str, np.ndarray], dict]]:
    """For each number of samples per pixel in `counts`: channels of the EXR file, `[H, W]` each, and facts for the manifest.

    The reference has `ref_spp` samples at most, fewer if its expected RelMSE is below `residual`, and four times those
    of a noisy image. A view is unsuitable if the RelMSE of an image with 4 samples per pixel is outside `noise`.
    """
    probe = trace(scene, PROBE_SAMPLES, seed)
    mean = brightness(probe["color"])
    scale = LUMINANCE / mean
    scene.cycles.sample_clamp_indirect = CLAMP * mean
    images = [trace(scene, count, seed + 1 + count, settings.threshold) for count in counts]
    halves, used, largest = [{}, {}], 0, max(ref_spp, REFERENCE_SHARE * max(counts))
    while True:
        # Each round doubles the samples.
        samples = max(FIRST_HALF, used // 2)
        for half, start in zip(halves, (0, samples)):
            traced = trace(scene, samples, seed + 100_000 + used + start)
            half |= {name: half.get(name, 0.0) + samples * traced[name] for name in ("color", *GUIDES)}
        used += 2 * samples
        means = {name: (halves[0][name] + halves[1][name]) / used for name in halves[0]}
        reference = means["color"] * scale
        error = rel_mse((halves[0]["color"] - halves[1]["color"]) * scale / used, reference)
        noises = [rel_mse(image["color"] * scale - reference, reference) - error for image in images]
        usual = noises[0] * counts[0] / USUAL
        if not noise[0] < usual < noise[1]:
            raise Unsuitable(f"noise {usual:.3f}")
        if error < min(residual, noises[-1] / REFERENCE_SHARE) or used >= largest:
            break
    found = []
    for count, image, noisy in zip(counts, images, noises):
        # Cycles has no mask; normal and position are 0 where no camera ray hits a surface.
        surface = np.any((image["normal"] != 0) | (image["position"] != 0), -1, keepdims=True)
        buffers = image | {"color": image["color"] * scale, "albedo2": image["albedo1"], "mask": surface, "ref.color": reference}
        buffers |= {f"ref.{name}": means[name] for name in GUIDES}
        facts = {
            "width": scene.render.resolution_x,
            "height": scene.render.resolution_y,
            "spp": count,
            "ref_spp": used,
            "seed": seed,
            "renderer": f"Cycles {bpy.app.version_string}",
            "exposure_scale": float(scale),
            "pixel_filter": settings.pixel_filter,
            "adaptive_threshold": settings.threshold,
            "noisy_relmse": noisy,
            "ref_residual_relmse": error,
            "mask_mean": float(surface.mean()),
        }
        found.append((file_channels(buffers, False), facts))
    return found
