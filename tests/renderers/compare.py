"""Compares demc with Open Image Denoise on files of Blender Cycles, Mitsuba, and LuxCore.

    python compare.py -o views [--scenes 1-4] [--renderers cycles,mitsuba,luxcore] [--model MODEL]

It renders each scene with 4 samples per pixel and its reference with 512 others, denoises it, and prints the table of
`docs/renderers.md`. Existing renders are kept, so an interrupted command can be repeated. Scenes 1 to 4 are reported:
choose nothing by their scores. Scenes 5 to 8 serve for choices.

The programs `demc-infer` and `demc-data` must be on the path. Python packages: bpy, mitsuba, pyluxcore, numpy, OpenEXR,
pyoidn.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from data_set import NAMES, buffers, channels

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent.parent / "tools"))
RENDERERS = {"cycles": "Blender Cycles", "mitsuba": "Mitsuba", "luxcore": "LuxCore"}
METHODS = {"noisy": "noisy", "demc": "demc", "oidn": "OIDN", "prefiltered": "OIDN, both denoised first"}
REFERENCE_SEED = 9
BLACK = 0.001
"""Keeps RelMSE finite where the reference is black."""


def rel_mse(image: np.ndarray, reference: np.ndarray) -> float:
    """RelMSE of `[H, W, 3]` linear images: sum over channels, mean over pixels (docs/evaluation.md)."""
    return float(((image - reference) ** 2 / (reference**2 + BLACK)).sum(-1).mean())


def ssim(image: np.ndarray, reference: np.ndarray) -> float:
    """SSIM of `[H, W, 3]` linear images in display space, inner windows only (docs/evaluation.md)."""
    offsets = np.arange(11) - 5
    weights = np.exp(-(offsets**2) / (2 * 1.5**2))
    weights /= weights.sum()

    def blur(plane: np.ndarray) -> np.ndarray:
        rows = sum(w * plane[i : plane.shape[0] - 10 + i] for i, w in enumerate(weights))
        return sum(w * rows[:, i : plane.shape[1] - 10 + i] for i, w in enumerate(weights))

    x, y = (picture.clip(0, 1).astype(np.float64) ** (1 / 2.2) for picture in (image, reference))
    mean_x, mean_y = blur(x), blur(y)
    variance_x, variance_y, covariance = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2, blur(x * y) - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    return float((luminance * (2 * covariance + c2) / (variance_x + variance_y + c2)).mean())


def run(*command: object) -> None:
    """Runs a program; shows its output if it fails."""
    result = subprocess.run([str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if result.returncode:
        sys.exit(f"error: {command[0]} failed\n{result.stdout[-2000:]}")


def rendered(renderer: str, number: int, options: argparse.Namespace) -> tuple[Path, Path]:
    """The files of the noisy image and of the reference, rendered if they are missing."""
    noisy, reference = (options.output / f"{renderer}-{number}{suffix}.exr" for suffix in ("", "-ref"))
    for path, settings in (noisy, ["--spp", 4]), (reference, ["--spp", options.ref_spp, "--seed", REFERENCE_SEED, "--plain"]):
        if not path.exists():
            unfinished = path.with_name(f"unfinished-{path.name}")
            run(sys.executable, HERE / f"with_{renderer}.py", number, unfinished, "--size", options.size, *settings)
            # The colour comes last: its file says that all are complete.
            for file in sorted(options.output.glob(f"{unfinished.stem}*.exr"), key=lambda file: -len(file.name)):
                os.replace(file, file.with_name(file.name.removeprefix("unfinished-")))
            print(path.name, file=sys.stderr, flush=True)
    return noisy, reference


def joined(path: Path, options: argparse.Namespace) -> Path:
    """LuxCore's files as one."""
    out = path.with_suffix(".joined.exr")
    features = [f"{buffer}={path.with_suffix(f'.{buffer}.exr')}" for buffer in ("albedo", "normal", "position")]
    out.unlink(missing_ok=True)
    run(options.demc_data, "merge", "-o", out, path, *features)
    return out


def image_of(renderer: str, path: Path) -> np.ndarray:
    """The colour of a file, `[H, W, 3]`."""
    planes = channels(path)
    start = NAMES.get(renderer, {"": ""})[""]
    return np.stack([planes[start + name] for name in "RGB"], -1).astype(np.float32)


def with_demc(renderer: str, noisy: Path, options: argparse.Namespace) -> np.ndarray:
    source = joined(noisy, options) if renderer == "luxcore" else noisy
    target = options.output / "demc" / noisy.name
    model = ["--model", options.model] if options.model else []
    run(options.demc_infer, "denoise", source, "-o", target, "--overwrite", *model)
    return image_of(renderer, target)


def with_oidn(renderer: str, noisy: Path) -> tuple[np.ndarray, np.ndarray]:
    """Open Image Denoise with albedo and normal as rendered, and with both denoised first."""
    import pyoidn
    from oidn import with_prefilter

    planes = buffers(renderer, noisy)
    color, albedo = (np.stack([planes[start + name] for name in "RGB"], -1) for start in ("", "albedo."))
    normal = np.stack([planes[f"normal.{name}"] for name in "XYZ"], -1)
    return pyoidn.denoise(color, albedo=albedo, normal=normal, hdr=True), with_prefilter(color, albedo, normal)


def scores(renderer: str, number: int, options: argparse.Namespace) -> dict[str, tuple[float, float]]:
    """RelMSE and SSIM of each method on one view."""
    noisy, reference = rendered(renderer, number, options)
    target = image_of(renderer, reference)
    images = {"noisy": image_of(renderer, noisy), "demc": with_demc(renderer, noisy, options)}
    images["oidn"], images["prefiltered"] = with_oidn(renderer, noisy)
    if options.pictures:
        picture(options.output / "pictures" / f"{renderer}-{number}.png", [*images.values(), target])
    return {method: (rel_mse(image, target), ssim(image, target)) for method, image in images.items()}


def picture(path: Path, images: list[np.ndarray]) -> None:
    """Images side by side in display space."""
    from PIL import Image

    path.parent.mkdir(exist_ok=True)
    row = np.concatenate(images, 1).clip(0, 1) ** (1 / 2.2)
    Image.fromarray((255 * row + 0.5).astype(np.uint8)).save(path)


def table(found: dict[str, dict[int, dict[str, tuple[float, float]]]]) -> str:
    """Means over the views of each renderer, in Markdown."""
    lines = [f"| metric | renderer | {' | '.join(METHODS.values())} | demc / OIDN |", "|---|---|" + (len(METHODS) + 1) * "---:|"]
    for index, metric in enumerate(("RelMSE", "SSIM")):
        for renderer, views in found.items():
            means = {method: np.mean([view[method][index] for view in views.values()]) for method in METHODS}
            cells = [f"{mean:.4f}" for mean in means.values()] + [f"{means['demc'] / means['oidn']:.2f}"]
            lines.append(f"| {metric} | {RENDERERS[renderer]} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="directory of all files, created if missing")
    parser.add_argument("--scenes", default="1-4", metavar="FIRST-LAST")
    parser.add_argument("--renderers", default=",".join(RENDERERS), help="comma-separated")
    parser.add_argument("--size", default="320x200")
    parser.add_argument("--ref-spp", type=int, default=512)
    parser.add_argument("--model", help="for demc-infer; default: the bundled model")
    parser.add_argument("--demc-infer", default="demc-infer", help="the program")
    parser.add_argument("--demc-data", default="demc-data", help="the program")
    parser.add_argument("--pictures", action="store_true", help="also write PNG files of each method and the reference (needs pillow)")
    parser.add_argument("--only-render", action="store_true", help="render and stop")
    options = parser.parse_args()
    first, _, last = options.scenes.partition("-")
    numbers = range(int(first), int(last or first) + 1)
    (options.output / "demc").mkdir(parents=True, exist_ok=True)
    found: dict[str, dict] = {renderer: {} for renderer in options.renderers.split(",")}
    for number in numbers:
        for renderer in found:
            if options.only_render:
                rendered(renderer, number, options)
            else:
                found[renderer][number] = scores(renderer, number, options)
    if not options.only_render:
        (options.output / f"scores-{options.scenes}.json").write_text(json.dumps(found, indent=1))
        print(table(found))


if __name__ == "__main__":
    main()
