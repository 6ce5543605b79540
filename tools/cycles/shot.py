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
FEATURES = {"normal": "Normal.XYZ", "position": "Position.XYZ", "albedo1": "Denoising Albedo.RGB"}
"""The pass and the channels of each buffer."""
GROUPS = ("sky", "lamps", "others")
"""Groups of lights that are rendered apart. Their sum is the image."""
BRIGHTER, REDDER = 1.0, 0.15
"""Standard deviations of the logarithms by which a group's brightness and its channels change."""
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


def draw_mixes(rng: Rng, images: int, share: float) -> np.ndarray:
    """Factors on each group's light in each image, by channel, `[images, 3, 3]`. A `share` of the views is lit anew in each image."""
    shape = images, len(GROUPS), 3
    changes = rng.normal(0, BRIGHTER, (*shape[:2], 1)) + rng.normal(0, REDDER, shape)
    return np.exp(changes) if rng.random() < share else np.ones(shape)


def lit(light: np.ndarray, mix: np.ndarray) -> np.ndarray:
    """The image, `[H, W, 3]`, from the light of each group, `[3, H, W, 3]`, and a mix, `[3, 3]`."""
    return np.einsum("ghwc,gc->hwc", light, mix)


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
    for group in GROUPS:
        layer.lightgroups.add(name=group)


def passes(scene: bpy.types.Scene) -> dict[str, np.ndarray]:
    """All channels of a rendered image, `[H, W]` each, by Blender's names."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "view.exr")
        scene.render.filepath = path
        with quiet():
            bpy.ops.render.render(write_still=True)
        with OpenEXR.File(path, separate_channels=True) as file:
            return {name: channel.pixels for part in range(len(file.parts)) for name, channel in file.channels(part).items()}


def trace(scene: bpy.types.Scene, samples: int, seed: int, threshold: float = 0.0) -> dict[str, np.ndarray]:
    """Renders `samples` per pixel and returns `FEATURES`, `[H, W, 3]` float64 each, and the `light` of each group, `[3, H, W, 3]`."""
    cycles = scene.cycles
    cycles.samples, cycles.seed = samples, seed % (1 << 31)
    cycles.use_adaptive_sampling = threshold > 0
    cycles.adaptive_threshold, cycles.adaptive_min_samples = threshold, max(1, samples // 8)
    planes = passes(scene)

    def image(name: str) -> np.ndarray:
        start, _, ends = name.rpartition(".")
        return np.stack([planes[f"ViewLayer.{start}.{end}"] for end in ends], -1).astype(np.float64)

    found = {buffer: image(name) for buffer, name in FEATURES.items()}
    found["light"] = np.stack([image(f"Combined_{group}.RGB") for group in GROUPS])
    for buffer, values in found.items():
        if not np.isfinite(values).all():
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
    scene: bpy.types.Scene,
    seed: int,
    counts: list[int],
    settings: Settings,
    mixes: np.ndarray,
    ref_spp: int,
    residual: float,
    noise: tuple[float, float],
) -> list[tuple[dict[str, np.ndarray], dict]]:
    """For each number of samples per pixel in `counts`: channels of the EXR file, `[H, W]` each, and facts for the manifest.

    Each image has its own of the `mixes` of light. The reference has `ref_spp` samples at most, fewer if its expected RelMSE
    is below `residual`, and four times those of a noisy image. A view is unsuitable if the RelMSE of an image, as if it
    had 4 samples per pixel, is outside `noise`.
    """
    probe = trace(scene, PROBE_SAMPLES, seed)["light"]
    scene.cycles.sample_clamp_indirect = CLAMP * brightness(probe.sum(0))
    images = [trace(scene, count, seed + 1 + count, settings.threshold) for count in counts]
    # The factors of each image include its exposure.
    factors = [mix * (LUMINANCE / brightness(lit(probe, mix))) for mix in mixes]
    halves, used, largest = [{}, {}], 0, max(ref_spp, REFERENCE_SHARE * max(counts))
    while True:
        # Each round doubles the samples.
        samples = max(FIRST_HALF, used // 2)
        for half, start in zip(halves, (0, samples)):
            traced = trace(scene, samples, seed + 100_000 + used + start)
            half |= {name: half.get(name, 0.0) + samples * traced[name] for name in ("light", *GUIDES)}
        used += 2 * samples
        means = {name: (halves[0][name] + halves[1][name]) / used for name in halves[0]}
        difference = (halves[0]["light"] - halves[1]["light"]) / used
        references = [lit(means["light"], mix) for mix in factors]
        errors = [rel_mse(lit(difference, mix), reference) for mix, reference in zip(factors, references)]
        noisy = [lit(image["light"], mix) for image, mix in zip(images, factors)]
        noises = [rel_mse(color - reference, reference) - error for color, reference, error in zip(noisy, references, errors)]
        for usual in np.multiply(noises, counts) / USUAL:
            if not noise[0] < usual < noise[1]:
                raise Unsuitable(f"noise {usual:.3f}")
        if used >= largest or all(error < min(residual, own / REFERENCE_SHARE) for error, own in zip(errors, noises)):
            break
    found = []
    for i, image in enumerate(images):
        features = {name: image[name] for name in FEATURES}
        # Cycles has no mask; normal and position are 0 where no camera ray hits a surface.
        surface = np.any((image["normal"] != 0) | (image["position"] != 0), -1, keepdims=True)
        buffers = features | {"color": noisy[i], "albedo2": image["albedo1"], "mask": surface, "ref.color": references[i]}
        buffers |= {f"ref.{name}": means[name] for name in GUIDES}
        facts = {
            "width": scene.render.resolution_x,
            "height": scene.render.resolution_y,
            "spp": counts[i],
            "ref_spp": used,
            "seed": seed,
            "renderer": f"Cycles {bpy.app.version_string}",
            "lights": {group: np.round(factor, 4).tolist() for group, factor in zip(GROUPS, factors[i])},
            "pixel_filter": settings.pixel_filter,
            "adaptive_threshold": settings.threshold,
            "noisy_relmse": noises[i],
            "ref_residual_relmse": errors[i],
            "mask_mean": float(surface.mean()),
        }
        found.append((file_channels(buffers, False), facts))
    return found
