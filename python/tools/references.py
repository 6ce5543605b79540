"""A data set again, the references that are trained on denoised by Intel's Open Image Denoise.

    pip install numpy OpenEXR pyoidn
    python python/tools/references.py --data data/rooms -o data/clean
    demc-train --config configs/renders.toml --set data.root=data/clean

For references of some hundred samples, whose own noise hides structure: Open Image Denoise, at so many samples, leaves more of it than
`data.reference_filter` does (results/renders). Where it would lighten what the samples say is dark by more than their noise explains, a black
slat before a window, the samples are believed. Its guides are texture and normals, denoised by themselves first: those of the reference's own samples
where the file has them (`ref.albedo1.R`, `ref.normal.X`, ...: python/render writes them), else those of the noisy image. All other channels are copied, scenes of the test split are listed where they are, and what is there
already is kept unless its source is newer. In the manifest `ref_denoised` tells the trainer, whose own filter leaves such references alone.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import numpy as np
from dataset import Scene, as_kind, manifest, write, write_manifest
from oidn import with_prefilter

LIGHTER = 3.0
"""Standard deviations of the noise that a pixel may get lighter by."""
LEAST_NOISE, MOST_NOISE = 0.01, 1.0
LOG_OFFSET = 0.02
"""Added to radiance before the logarithm: black has one."""
BLOCK, MARGIN = 16, 8
"""Noise is measured once for a block of pixels, over it and so many more on each side."""
MAD = 1.4826
"""From the median of absolute values to the standard deviation of a normal distribution."""


def clean(reference: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The reference denoised; all `[H, W, 3]` float32, in linear HDR. Negative samples count as 0."""
    samples = reference.clip(0)
    deviation = noise(np.log(samples + LOG_OFFSET).mean(-1))[..., None]
    most = (samples + LOG_OFFSET) * np.exp(LIGHTER * deviation) - LOG_OFFSET
    return np.minimum(with_prefilter(samples, albedo, normal), most)


def guide(scene: Scene, prefix: str, names: str) -> np.ndarray:
    """A feature of the reference's own samples where the file has it (python/render writes it), else of the noisy image's."""
    of_reference = f"ref.{prefix}{names[0]}" in scene.channels
    return scene.rgb(f"ref.{prefix}" if of_reference else prefix, names)


def noise(plane: np.ndarray) -> np.ndarray:
    """Standard deviation of the noise around each pixel, `[H, W]`: from how far pixels are from the mean of their four neighbours, by block, as
    `demc-data`'s `reference_filter` measures it."""
    padded = np.pad(plane, 1, mode="edge")
    neighbours = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
    distance = np.abs(plane - neighbours / 4)
    out = np.empty_like(plane)
    for top in range(0, plane.shape[0], BLOCK):
        for left in range(0, plane.shape[1], BLOCK):
            rows, columns = (slice(max(0, start - MARGIN), start + BLOCK + MARGIN) for start in (top, left))
            # A pixel less the mean of four has 5/4 of one pixel's variance.
            out[top : top + BLOCK, left : left + BLOCK] = MAD * np.median(distance[rows, columns]) / 1.25**0.5
    return out.clip(LEAST_NOISE, MOST_NOISE)


def stale(target: Path, source: Path) -> bool:
    """Whether the target is missing, or not of the source as it is now."""
    return not target.exists() or target.stat().st_mtime < source.stat().st_mtime


def rewrite(source: Path, target: Path) -> None:
    scene = Scene(source)
    cleaned = clean(scene.rgb("ref."), guide(scene, "albedo1.", "RGB"), guide(scene, "normal.", "XYZ"))
    if not np.isfinite(cleaned).all():
        raise ValueError(f"{source}: the denoised reference has NaN or infinite values")
    for i, name in enumerate("RGB"):
        scene.channels["ref." + name] = as_kind(cleaned[..., i], scene.channels["ref." + name].dtype)
    target.parent.mkdir(parents=True, exist_ok=True)
    write(target, scene.channels, scene.about)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the directory with manifest.json")
    parser.add_argument("-o", "--output", type=Path, required=True, help="directory of the new data set, made if needed")
    arguments = parser.parse_args()
    data, output = arguments.data, arguments.output
    try:
        if output.resolve() == data.resolve():
            raise ValueError(f"{output} is the data set itself")
        listed = manifest(data)
        output.mkdir(parents=True, exist_ok=True)
        denoised = 0
        for scene in listed["scenes"]:
            source = data / scene["file"]
            if scene["split"] == "train":
                scene |= {"file": f"train/{scene['name']}.exr", "ref_denoised": "Open Image Denoise"}
                scene.pop("ref_residual_relmse", None)
                if stale(output / scene["file"], source):
                    rewrite(source, output / scene["file"])
                    denoised += 1
            else:
                scene["file"] = os.path.relpath(source.resolve(), output.resolve())
        write_manifest(output, listed)
        print(f"{output}: {denoised} references denoised, {len(listed['scenes'])} scenes listed")
    except (OSError, ValueError, KeyError, RuntimeError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
