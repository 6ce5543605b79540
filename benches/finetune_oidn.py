"""Fine-tunes Open Image Denoise (OIDN) for three renderers with `configs/oidn.toml`, and scores the result.

    pip install bpy mitsuba pyluxcore numpy OpenEXR pyoidn pillow
    python benches/finetune_oidn.py -o runs/oidn-bar --public data/renders [--renderers cycles]

For each renderer: ten generated views to train on and ten others to score, 4 samples per pixel; the training
scenes of `data/sample` beside them. The scores are those of the fine-tuned weights, and of OIDN with denoised
guides; both beside those of OIDN with the guides as rendered. The test scenes of `--public` tell what was
forgotten. `before-after.png` shows a test view of each renderer: noisy, OIDN, fine-tuned, reference. Finished parts
are kept, so an interrupted command can be repeated.
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pyoidn
from oidn import ROOT
from PIL import Image

PROGRAMS = ROOT / "target" / "release"
RENDERERS = ("cycles", "luxcore", "mitsuba")
TRAIN, TEST = "501-510", "511-520"
"""Numbers of the scenes. No setting was chosen by them."""
OIDN = ["oidn", "oidn-prefilter"]
CROP = 96
"""Pixels of a side that the picture leaves out."""
METRICS = ("relmse", "ssim", "energy-bias")


def run(*command: object) -> None:
    subprocess.run([*map(str, command)], check=True)


def shown(path: Path, prefix: str = "") -> np.ndarray:
    """An image in gamma space, `[height, width, 3]` of 8 bits."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        linear = np.stack([channels[prefix + name].pixels.astype(np.float32) for name in "RGB"], axis=-1)
    return (255 * linear.clip(0, 1) ** (1 / 2.2)).round().astype(np.uint8)


def before_after(data: Path, number: int, model: Path, folder: Path) -> np.ndarray:
    """The middle of a test view, twice as large: noisy, OIDN, fine-tuned, reference."""
    view = sorted((data / "test").glob("*.exr"))[number]
    tuned = folder / f"{view.stem}-tuned.exr"
    run(PROGRAMS / "demc-infer", "denoise", "--model", model, view, "-o", tuned, "--overwrite")
    oidn = folder / f"{data.name}-oidn" / view.name
    images = [shown(view), shown(oidn), shown(tuned), shown(view, "ref.")]
    middle = slice(CROP // 2, -CROP // 2)
    return np.concatenate([image[middle, middle].repeat(2, 0).repeat(2, 1) for image in images], axis=1)


def scores(data: Path, model: Path, folder: Path) -> dict[str, dict[str, float]]:
    """Means over the test split: of the model (`tuned`), and of OIDN's ways."""
    made = {name: folder / f"{data.name}-{name}" for name in OIDN}
    for name, images in made.items():
        if not images.exists():
            run(sys.executable, ROOT / "tools/baselines.py", name, "--data", data, "-o", images)
    report = folder / f"{model.name}-{data.name}.json"
    flags = [word for name, images in made.items() for word in ("--baseline", f"{name}={images}")]
    run(PROGRAMS / "demc-infer", "evaluate", "--model", model, "--data", data, *flags, "--json", report, "--overwrite")
    images = [{"tuned": image["denoised"]} | image["baselines"] for image in json.loads(report.read_text())["images"]]

    def mean(name: str, metric: str) -> float:
        return statistics.fmean(abs(image[name][metric]) for image in images)

    return {name: {metric: mean(name, metric) for metric in METRICS} for name in images[0]}


def cells(mean: dict[str, float], plain: dict[str, float]) -> str:
    """Scores beside those of OIDN with guides as rendered."""
    ratio, gain = mean["relmse"] / plain["relmse"], mean["ssim"] - plain["ssim"]
    return f"{ratio:.2f} | {gain:+.4f} | {100 * mean['energy-bias']:.2f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--public", type=Path, metavar="DIR", help="data set whose test scenes tell what was forgotten")
    parser.add_argument("--renderers", nargs="+", choices=RENDERERS, default=RENDERERS)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    library = next(Path(pyoidn.__file__).parent.rglob("libOpenImageDenoise_core.*"))
    start = args.output / "unet.safetensors"
    run(PROGRAMS / "demc-infer", "import", "--oidn", library, "-o", start, "--overwrite")
    rows, pictures = [], []
    for renderer in args.renderers:
        data = args.output / renderer
        make = sys.executable, ROOT / "tests/renderers/data_set.py", renderer
        how = "-o", data, "--ref-spp", 512
        run(*make, TRAIN, *how)
        run(*make, TEST, *how, "--split", "test")
        run(PROGRAMS / "demc-data", "index", data, "--with", ROOT / "data/sample", "--overwrite")
        tuned = args.output / f"run-{renderer}"
        if not (tuned / "test.json").exists():
            keys = "--set", f"data.root={data}", "--set", f"train.init={start}"
            run(PROGRAMS / "demc-train", "--config", ROOT / "configs/oidn.toml", *keys, "--run-dir", tuned)
        means = [scores(place, tuned, args.output) for place in (data, *([args.public] if args.public else []))]
        for name, label in (("tuned", "fine-tuned"), ("oidn-prefilter", "OIDN, guides denoised first")):
            rows.append([renderer, label, *(cells(mean[name], mean["oidn"]) for mean in means)])
        pictures.append(before_after(data, len(pictures), tuned, args.output))
    Image.fromarray(np.concatenate(pictures)).save(args.output / "before-after.png", optimize=True)
    print("| renderer | weights | unseen views: RelMSE / OIDN | SSIM - OIDN | energy bias | test scenes: RelMSE / OIDN | SSIM - OIDN | energy bias |")
    print("|---|---|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
