"""Fine-tunes Open Image Denoise (OIDN) for three renderers with `configs/oidn.toml`, and scores the result.

    pip install bpy mitsuba pyluxcore numpy OpenEXR pyoidn pillow
    python benches/finetune_oidn.py -o runs/oidn-bar --public data/renders [--renderers cycles]

For each renderer: ten generated views to train on and ten others to score, 4 samples per pixel; the training
scenes of `data/sample` beside them. Two ways: guides as rendered, and guides denoised first by OIDN, in
training and test. The scores are those of the fine-tuned weights and of OIDN in both ways, then on the test
scenes of `--public`, which tell what was forgotten. `before-after.png` shows the first test view of each renderer:
noisy, OIDN, fine-tuned, fine-tuned with denoised guides, reference. Finished parts are kept, so an interrupted
command can be repeated.
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
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = ROOT / "target" / "release"
RENDERERS = ("cycles", "luxcore", "mitsuba")
TRAIN, TEST = "501-510", "511-520"
"""Numbers of the scenes. No setting was chosen by them."""
WAYS = {"as rendered": ("rt_hdr_alb_nrm", ""), "denoised": ("rt_hdr_calb_cnrm", "-clean")}
"""Guides: OIDN's weights to start from, and the ending of folders."""
OIDN = ["oidn", "oidn-prefilter"]
METRICS = ("relmse", "ssim", "energy-bias")


def run(*command: object) -> None:
    subprocess.run([*map(str, command)], check=True)


def shown(path: Path, prefix: str = "") -> np.ndarray:
    """An image in gamma space, `[height, width, 3]` of 8 bits."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        linear = np.stack([channels[prefix + name].pixels.astype(np.float32) for name in "RGB"], axis=-1)
    return (255 * linear.clip(0, 1) ** (1 / 2.2)).round().astype(np.uint8)


def before_after(data: Path, folder: Path) -> np.ndarray:
    """The first test view: noisy, OIDN, fine-tuned in both ways, reference."""
    view = min((data / "test").glob("*.exr"))
    images = [shown(view), shown(folder / f"{data.name}-oidn" / view.name)]
    for _, ending in WAYS.values():
        source = folder / f"{data.name}{ending}" / "test" / view.name
        tuned = folder / f"{view.stem}-tuned{ending}.exr"
        run(PROGRAMS / "demc-infer", "denoise", "--model", folder / f"run-{data.name}{ending}", source, "-o", tuned, "--overwrite")
        images.append(shown(tuned))
    return np.concatenate([*images, shown(view, "ref.")], axis=1)


def scores(data: Path, ending: str, model: Path, folder: Path) -> dict[str, dict[str, float]]:
    """Means over the test split: of the model (`tuned`), and of OIDN's ways."""
    made = {name: folder / f"{data.name}-{name}" for name in OIDN}
    for name, images in made.items():
        if not images.exists():
            run(sys.executable, ROOT / "tools/baselines.py", name, "--data", data, "-o", images)
    report = folder / f"{model.name}-{data.name}.json"
    flags = [word for name, images in made.items() for word in ("--baseline", f"{name}={images}")]
    seen = guided(data, folder) if ending else data
    run(PROGRAMS / "demc-infer", "evaluate", "--model", model, "--data", seen, *flags, "--json", report, "--overwrite")
    images = [{"tuned": image["denoised"]} | image["baselines"] for image in json.loads(report.read_text())["images"]]

    def mean(name: str, metric: str) -> float:
        return statistics.fmean(abs(image[name][metric]) for image in images)

    return {name: {metric: mean(name, metric) for metric in METRICS} for name in images[0]}


def cells(mean: dict[str, float], plain: dict[str, float]) -> str:
    """Scores beside those of OIDN with guides as rendered."""
    ratio, gain = mean["relmse"] / plain["relmse"], mean["ssim"] - plain["ssim"]
    return f"{ratio:.2f} | {gain:+.4f} | {100 * mean['energy-bias']:.2f} %"


def guided(data: Path, folder: Path) -> Path:
    """The copy of a data set with denoised guides; of `--public` the test scenes alone."""
    copy, flags = folder / f"{data.name}-clean", () if data.parent == folder else ("--split", "test")
    run(sys.executable, ROOT / "tools/guides.py", "--data", data, "-o", copy, *flags)
    return copy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--public", type=Path, metavar="DIR", help="data set whose test scenes tell what was forgotten")
    parser.add_argument("--renderers", nargs="+", choices=RENDERERS, default=RENDERERS)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    library = next(Path(pyoidn.__file__).parent.rglob("libOpenImageDenoise_core.*"))
    for weights, _ in WAYS.values():
        start = args.output / f"{weights}.safetensors"
        run(PROGRAMS / "demc-infer", "import", "--oidn", library, "--weights", weights, "-o", start, "--overwrite")
    rows, pictures = [], []
    for renderer in args.renderers:
        data = args.output / renderer
        make = sys.executable, ROOT / "tests/renderers/data_set.py", renderer
        how = "-o", data, "--ref-spp", 512
        run(*make, TRAIN, *how)
        run(*make, TEST, *how, "--split", "test")
        run(PROGRAMS / "demc-data", "index", data, "--with", ROOT / "data/sample", "--overwrite")
        for way, (weights, ending) in WAYS.items():
            tuned = args.output / f"run-{renderer}{ending}"
            if not (tuned / "test.json").exists():
                own = guided(data, args.output) if ending else data
                keys = "--set", f"data.root={own}", "--set", f"train.init={args.output / weights}.safetensors"
                run(PROGRAMS / "demc-train", "--config", ROOT / "configs/oidn.toml", *keys, "--run-dir", tuned)
            places = data, *([args.public] if args.public else [])
            means = [scores(place, ending, tuned, args.output) for place in places]
            rows.append([f"{renderer}, guides {way}", *(cells(mean["tuned"], mean["oidn"]) for mean in means)])
        rows.append([f"{renderer}, OIDN with denoised guides", *(cells(mean["oidn-prefilter"], mean["oidn"]) for mean in means)])
        pictures.append(before_after(data, args.output))
    Image.fromarray(np.concatenate(pictures)).save(args.output / "before-after.png", optimize=True)
    print("| weights of | unseen views: RelMSE / OIDN | SSIM - OIDN | energy bias | test scenes: RelMSE / OIDN | SSIM - OIDN | energy bias |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
