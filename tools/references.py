"""Writes a copy of a data set whose training references are denoised by Intel's Open Image Denoise.

    pip install numpy OpenEXR pyoidn
    python tools/references.py --data data/rooms -o data/clean
    demc-train --config configs/renders.toml --set data.root=data/clean

Use it for references of some hundred samples per pixel, which have visible noise
(results/experiments.md has its effect).

- The channels are found as `demc-infer` finds them, per file (docs/data.md#channel-layouts).
- Its guides are albedo and normal, both denoised first. They come from the reference's own samples
  if the file has them, otherwise from the noisy image. Their names are `ref.` and the name of the
  noisy channel (`ref.albedo1.R`, `ref.normal.X`, ...; tools/render writes them).
- `--albedo-filter MODEL` also replaces the noisy albedo (first hit) by what an albedo filter makes of it:
  what a network with that filter sees when it denoises. MODEL is an exported model with a filter, or a
  filter alone. Needs PyTorch.
- A pixel gets at most as bright as the noise of its samples allows. This keeps black slats in front
  of a window black.
- All other channels and attributes are copied. Scenes of the test split are listed, not copied.
- Existing files are kept unless their source is newer.
- `ref_denoised` in the manifest marks the denoised references.
- `--shard I/N` denoises a part of the references on a farm (docs/farms.md).
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from dataset import add_layout_flags, albedo, manifest, normal, pixels, reference, write_manifest
from demc.torch.exr import Frame, read_exr
from demc.torch.shard import add_shard_flag
from oidn import with_prefilter

if TYPE_CHECKING:
    from demc.torch import Bundle

LIGHTER = 3.0
"""Limit for brightening a pixel, in standard deviations of the noise."""
LEAST_NOISE, MOST_NOISE = 0.01, 1.0
LOG_OFFSET = 0.02
"""Added to radiance before the logarithm, so that black has a finite one."""
BLOCK, MARGIN = 16, 8
"""Noise is measured per block, over the block and a margin on each side. In pixels."""
MAD = 1.4826
"""Standard deviation of a normal distribution with median absolute value 1."""


def clean(reference: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The denoised reference.

    All arrays are `[H, W, 3]` float32, linear HDR. Negative samples count as 0.
    """
    samples = reference.clip(0)
    deviation = noise(np.log(samples + LOG_OFFSET).mean(-1))[..., None]
    most = (samples + LOG_OFFSET) * np.exp(LIGHTER * deviation) - LOG_OFFSET
    return np.minimum(with_prefilter(samples, albedo, normal), most)


def guide(frame: Frame, buffer: str, noisy: np.ndarray) -> np.ndarray:
    """A feature of the reference's own samples if the file has it, otherwise `noisy`."""
    names = [f"ref.{name}" for name in frame.layout.channels.get(buffer, ())]
    return pixels(frame.file.planes(names)) if names and names[0] in frame.file.channels else noisy


def noise(plane: np.ndarray) -> np.ndarray:
    """Standard deviation of the noise around each pixel, `[H, W]`.

    It is estimated per block from the differences between pixels and the mean of their four
    neighbours.
    """
    padded = np.pad(plane, 1, mode="edge")
    neighbours = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
    distance = np.abs(plane - neighbours / 4)
    out = np.empty_like(plane)
    for top in range(0, plane.shape[0], BLOCK):
        for left in range(0, plane.shape[1], BLOCK):
            rows, columns = (slice(max(0, start - MARGIN), start + BLOCK + MARGIN) for start in (top, left))
            # A pixel minus the mean of four others has 5/4 of one pixel's variance.
            out[top : top + BLOCK, left : left + BLOCK] = MAD * np.median(distance[rows, columns]) / 1.25**0.5
    return out.clip(LEAST_NOISE, MOST_NOISE)


def filtering(path: Path) -> Bundle:
    """A model with the albedo filter of the file, or with the network of the file as its filter."""
    from demc.torch import load

    model = load(path)
    return model if model.albedo_filter else replace(model, albedo_filter=model)


def stale(target: Path, source: Path) -> bool:
    """Whether the target is missing or older than the source."""
    return not target.exists() or target.stat().st_mtime < source.stat().st_mtime


def rewrite(source: Path, target: Path, layout: str | None, layer: str | None, model: Bundle | None) -> None:
    frame = read_exr(source, layout, layer)
    cleaned = clean(
        reference(frame), guide(frame, "texture1", albedo(frame)), guide(frame, "normal", normal(frame))
    )
    if not np.isfinite(cleaned).all():
        raise ValueError(f"{source}: the denoised reference contains NaN or infinite values")
    target.parent.mkdir(parents=True, exist_ok=True)
    planes = dict(zip(frame.layout.channels["reference"], cleaned.transpose(2, 0, 1)))
    if model:
        planes |= zip(frame.layout.channels["texture1"], model.filtered_albedo(frame.color, frame.features))
    frame.file.write(target, planes)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="directory with manifest.json")
    parser.add_argument("-o", "--output", type=Path, required=True, help="directory of the new data set, created if missing")
    parser.add_argument("--albedo-filter", type=Path, metavar="MODEL", help="exported albedo filter, or a model that has one")
    add_layout_flags(parser)
    add_shard_flag(parser, "training scenes")
    arguments = parser.parse_args()
    data, output, shard = arguments.data, arguments.output, arguments.shard
    try:
        if output.resolve() == data.resolve():
            raise ValueError(f"{output}: expected another directory than --data")
        model = filtering(arguments.albedo_filter) if arguments.albedo_filter else None
        listed = manifest(data)
        output.mkdir(parents=True, exist_ok=True)
        denoised = 0
        names = {scene["name"] for scene in listed["scenes"] if scene["split"] == "train"}
        own = shard.keep(names) if shard else names
        for scene in listed["scenes"]:
            source = data / scene["file"]
            if scene["split"] == "train":
                scene |= {"file": f"train/{scene['name']}.exr", "ref_denoised": "Open Image Denoise"}
                scene.pop("ref_residual_relmse", None)
                if scene["name"] in own and stale(output / scene["file"], source):
                    rewrite(source, output / scene["file"], arguments.layout, arguments.layer, model)
                    denoised += 1
            else:
                scene["file"] = os.path.relpath(source.resolve(), output.resolve())
        done = f"{output}: {denoised} references denoised"
        if shard:
            print(f"{done}; shard {shard} is complete")
        else:
            write_manifest(output, listed)
            print(f"{done}, {len(listed['scenes'])} scenes listed")
    except (OSError, ValueError, KeyError, RuntimeError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
