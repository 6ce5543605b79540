#!/usr/bin/env python3
"""Compares models with Open Image Denoise (OIDN): the table of the model card.

    pip install numpy OpenEXR pillow pyoidn
    python3 benches/quality.py --data public=data/renders --data held-out=data/heldout

Each row is one program on the test scenes of one data set with one number of samples per pixel; with 4, also
on those of each kind and of each renderer. A ratio or difference compares with the better of OIDN (quality
high) with albedo and normal, plain and denoised first, per column. Intervals are 95 % bootstrap intervals
over scenes. The images of OIDN and the scores are kept in --work.

--pictures also shows the hardest views: the noisy image, the first model, OIDN plain and with both denoised first,
the reference. `hardest-4spp.jpg` has the four with the largest RelMSE of the model, `kinds.jpg` one of each
kind of scene and of each renderer.
"""
import argparse
import json
import pathlib
import subprocess
import sys

import numpy as np

ROOT = pathlib.Path(__file__).resolve().parent.parent
PEERS = ("oidn", "oidn-prefilter", "oidn-fast", "oidn-fast-prefilter")
BEST_OF = PEERS[:2]
BUNDLED = [(name, pathlib.Path(name)) for name in ("quality", "fast")]
DRAWS = 10_000
COLUMNS = {
    # Name: (value of a program from its scenes, whether the comparison is a ratio, whether less is better)
    "RelMSE": (lambda scores: scores["relmse"].mean(-1), True, True),
    "geometric mean": (lambda scores: np.exp(np.log(scores["relmse"]).mean(-1)), True, True),
    "SSIM": (lambda scores: scores["ssim"].mean(-1), False, False),
    "FLIP": (lambda scores: scores["flip"].mean(-1), True, True),
    "energy bias, absolute": (lambda scores: np.abs(scores["energy-bias"]).mean(-1), False, True),
}
USUAL = 4
"""Samples per pixel of the tables per kind of scene and per renderer."""
METRICS = ("relmse", "ssim", "flip", "energy-bias")
HARDEST = 4
"""Views of a picture."""
SHOWN = 0.25
"""Mean of a reference in a picture."""


def pair(text: str) -> tuple[str, pathlib.Path]:
    name, equals, path = text.partition("=")
    if not (name and equals and path):
        raise argparse.ArgumentTypeError("expected NAME=PATH")
    return name, pathlib.Path(path)


def run(*command: object) -> None:
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)


def scores_of(data: pathlib.Path, model: tuple[str, pathlib.Path], work: pathlib.Path, program: str) -> dict:
    """`{scene: {program: {metric: value}}}` of a model, the noisy image, and the peers."""
    name, path = model
    baselines = []
    for peer in PEERS:
        images = work / peer
        if not (images / "complete").exists():
            run(sys.executable, ROOT / "tools/baselines.py", peer, "--data", data, "-o", images)
            (images / "complete").touch()
        baselines += ["--baseline", f"{peer}={images}"]
    report = work / f"{name}.json"
    run(program, "evaluate", "--model", path, "--data", data, "--metrics", "flip,energy-bias", "--json", report, "--overwrite", *baselines)
    images = json.loads(report.read_text())["images"]
    return {image["name"]: {"noisy": image["noisy"], name: image["denoised"]} | image["baselines"] for image in images}


def groups(data: pathlib.Path) -> dict[str, list[str]]:
    """The test scenes of each number of samples per pixel, of each kind, and of each renderer.

    `tools/render` and `tools/cycles` write the kind. Other scenes have the first word of their name, such as `room`.
    """
    manifest = json.loads((data / "manifest.json").read_text())
    scenes = sorted((scene for scene in manifest["scenes"] if scene["split"] == "test"), key=lambda scene: scene["spp"])
    counts: dict[str, list[str]] = {}
    parts: dict[str, list[str]] = {}
    for scene in scenes:
        counts.setdefault(f"{scene['spp']} spp", []).append(scene["name"])
        if scene["spp"] == USUAL:
            renderer = scene.get("renderer", manifest.get("renderer", "unknown renderer")).split(" ")[0]
            for part in (scene.get("kind", scene["name"].split("-")[0]), renderer):
                parts.setdefault(f"{part}, {USUAL} spp", []).append(scene["name"])
    # A part that has all scenes says nothing new.
    return counts | {part: names for part, names in sorted(parts.items()) if names != counts[f"{USUAL} spp"]}


def table(scores: dict, scenes: list[str]) -> list[list[str]]:
    """Rows of a data set and sample count: program, then a cell per column."""
    programs = list(scores[scenes[0]])
    values = {
        program: {metric: np.array([scores[scene][program][metric] for scene in scenes]) for metric in METRICS} for program in programs
    }
    draws = np.random.default_rng(1).integers(len(scenes), size=(DRAWS, len(scenes)))
    rows = []
    for program in programs:
        row = [program]
        for value, is_ratio, less in COLUMNS.values():
            own = value(values[program])
            best = min(BEST_OF, key=lambda peer: float(value(values[peer])) * (1 if less else -1))
            drawn = [value({metric: array[draws] for metric, array in values[one].items()}) for one in (program, best)]
            compare = (lambda a, b: a / b) if is_ratio else (lambda a, b: a - b)
            low, high = np.quantile(compare(*drawn), [0.025, 0.975])
            form = "{:.3f}" if is_ratio else "{:+.4f}"
            shown = compare(own, value(values[best]))
            row.append(f"{own:.4f}: " + " (".join(form.format(part) for part in (shown, low)) + " to " + form.format(high) + ")")
        rows.append(row)
    return rows


def pixels(path: pathlib.Path, prefix: str = "") -> np.ndarray:
    """An image in linear HDR, `[height, width, 3]`."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.stack([file.channels()[prefix + name].pixels.astype(np.float32) for name in "RGB"], -1)


def view(data: pathlib.Path, scene: str, model: pathlib.Path, work: pathlib.Path, program: str) -> np.ndarray:
    """A row of a picture, 8 bits in gamma space: noisy, the model, OIDN's ways, reference."""
    entry = next(entry for entry in json.loads((data / "manifest.json").read_text())["scenes"] if entry["name"] == scene)
    source, own = data / entry["file"], work / "denoised.exr"
    run(program, "denoise", "--model", model, source, "-o", own, "--overwrite")
    reference = pixels(source, "ref.")
    images = [pixels(source), pixels(own), *(pixels(work / peer / f"{source.stem}.exr") for peer in BEST_OF), reference]
    row = np.concatenate(images, axis=1) * SHOWN / reference.mean()
    return (255 * row.clip(0, 1) ** (1 / 2.2)).round().astype(np.uint8)


def draw(scores: dict, data: pathlib.Path, model: tuple[str, pathlib.Path], work: pathlib.Path, program: str, folder: pathlib.Path) -> None:
    """The pictures of a data set."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    pictures: dict[str, list[str]] = {}
    for group, scenes in groups(data).items():
        part, _, count = group.rpartition(", ")
        hardest = sorted(scenes, key=lambda scene: -scores[scene][model[0]]["relmse"])
        if part:
            pictures.setdefault("kinds", []).append(hardest[0])
        else:
            pictures["hardest-" + count.replace(" ", "")] = hardest[:HARDEST]
    for name, scenes in pictures.items():
        # The hardest view of a kind is often that of its renderer, too.
        rows = [view(data, scene, model[1], work, program) for scene in dict.fromkeys(scenes)]
        width = max(row.shape[1] for row in rows)
        rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
        Image.fromarray(np.concatenate(rows)).save(folder / f"{name}.jpg", quality=90)
        print(f"{folder / name}.jpg: {', '.join(dict.fromkeys(scenes))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", action="append", type=pair, required=True, metavar="NAME=DIR", help="data set with test scenes; can be repeated")
    parser.add_argument("--model", action="append", type=pair, metavar="NAME=FILE", help="exported weights; can be repeated [both bundled models]")
    parser.add_argument("--work", type=pathlib.Path, default=ROOT / "runs/compared", metavar="DIR", help="OIDN's images and the scores [runs/compared]")
    parser.add_argument("--program", default=str(ROOT / "target/release/demc-infer"), metavar="FILE", help="demc-infer [target/release/demc-infer]")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="DIR", help="folder for pictures of the hardest views of each data set")
    args = parser.parse_args()
    models = args.model or BUNDLED
    for data_name, data in args.data:
        scores: dict[str, dict] = {}
        work = args.work / data_name
        work.mkdir(parents=True, exist_ok=True)
        for model in models:
            for scene, programs in scores_of(data, model, work, args.program).items():
                scores.setdefault(scene, {}).update(programs)
        for group, scenes in groups(data).items():
            print(f"\n{data_name}, {group}, {len(scenes)} scenes\n")
            print("| program | " + " | ".join(COLUMNS) + " |\n|---|" + "---:|" * len(COLUMNS))
            for row in table(scores, scenes):
                print("| " + " | ".join(row) + " |")
        for name, _ in models:
            worse = [scene for scene, programs in scores.items() if programs[name]["relmse"] > programs["noisy"]["relmse"]]
            print(f"\n{name}: larger RelMSE than the noisy image in {len(worse)} of {len(scores)} images {' '.join(worse)}")
        if args.pictures:
            draw(scores, data, models[0], work, args.program, args.pictures / data_name)


if __name__ == "__main__":
    main()
