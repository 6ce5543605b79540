"""Renders scenes of `scenes.py` with a stock renderer into a data set for `demc-train`.

    python data_set.py cycles 101-160 -o data/stock --ref-spp 128 [--size 224x224]

Each view becomes one file of the layout `demc-exr`: colour and features of 4 samples per pixel, and a reference with
other samples, whose own albedo and normal are kept for `tools/references.py`. The second albedo is a copy of the
first. Existing files are kept, so an interrupted command can be repeated. `docs/renderers.md` reports scenes 1 to 4; this
script refuses them. `--split test` lists views that training does not see. `--copies` lists each view several times, so that a few views count more.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenEXR

HERE = Path(__file__).parent
REPORTED = range(1, 5)
FEATURES = {"normal": "XYZ", "position": "XYZ", "albedo": "RGB"}
NAMES = {
    "cycles": {"": "ViewLayer.Combined.", "normal": "ViewLayer.Normal.", "position": "ViewLayer.Position.", "albedo": "ViewLayer.Denoising Albedo."},
    "mitsuba": {"": "", "normal": "normal.", "position": "position.", "albedo": "albedo."},
}


def channels(path: Path) -> dict[str, np.ndarray]:
    """All channels of all parts."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for part in range(len(file.parts)) for name, channel in file.channels(part).items()}


def buffers(renderer: str, path: Path) -> dict[str, np.ndarray]:
    """The colour (`R`, `G`, `B`) and the features (`normal.X`, ...) of a rendered file."""
    out = {}
    for buffer, letters in ({"": "RGB"} | FEATURES).items():
        start = f"{buffer}." if buffer else ""
        if renderer == "luxcore":
            file = channels(path if not buffer else path.with_suffix(f".{buffer}.exr"))
            planes = [file[name] for name in "RGB"]
        else:
            file = channels(path)
            planes = [file[NAMES[renderer][buffer] + name] for name in letters]
        for name, plane in zip(letters, planes):
            # LuxCore's positions where a camera ray hits nothing are infinite.
            out[start + name] = np.where(np.isfinite(plane), plane, 0).astype(np.float32)
    return out


def view(renderer: str, number: int, options: argparse.Namespace) -> dict[str, np.ndarray]:
    """The channels of one view."""
    with tempfile.TemporaryDirectory() as directory:
        rendered = []
        for name, spp, seed in (("noisy", options.spp, number), ("reference", options.ref_spp, number + 100_000)):
            path = Path(directory) / f"{name}.exr"
            command = [sys.executable, HERE / f"with_{renderer}.py", str(number), path, "--spp", str(spp), "--size", options.size, "--seed", str(seed)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            rendered.append(buffers(renderer, path))
    noisy, reference = rendered
    out = {name.replace("albedo.", "albedo1."): plane for name, plane in noisy.items()}
    out |= {f"albedo2.{name}": noisy[f"albedo.{name}"] for name in "RGB"}
    out |= {f"ref.{name}": reference[name] for name in "RGB"}
    out |= {f"ref.albedo1.{name}": reference[f"albedo.{name}"] for name in "RGB"}
    out |= {f"ref.normal.{name}": reference[f"normal.{name}"] for name in "XYZ"}
    # The renderers have no mask; normal and position are 0 where no camera ray hits a surface.
    out["mask.A"] = np.any([noisy[f"{name}.{axis}"] != 0 for name in ("normal", "position") for axis in "XYZ"], 0).astype(np.float32)
    return {name: plane if name.startswith("position") else half(plane) for name, plane in out.items()}


def half(plane: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(plane.clip(-65504, 65504).astype(np.float16))


def write(path: Path, planes: dict[str, np.ndarray]) -> None:
    unfinished = path.with_suffix(".unfinished")
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(unfinished))
    os.replace(unfinished, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renderer", choices=["cycles", "mitsuba", "luxcore"])
    parser.add_argument("scenes", metavar="FIRST-LAST")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--size", default="224x224")
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--ref-spp", type=int, default=128)
    parser.add_argument("--split", choices=["train", "test"], default="train")
    parser.add_argument("--copies", type=int, default=1)
    options = parser.parse_args()
    first, _, last = options.scenes.partition("-")
    numbers = range(int(first), int(last or first) + 1)
    if any(number in REPORTED for number in numbers):
        parser.error(f"scenes {REPORTED[0]} to {REPORTED[-1]} are for tests only")
    (options.output / options.split).mkdir(parents=True, exist_ok=True)
    manifest = options.output / "manifest.json"
    listed = json.loads(manifest.read_text()) if manifest.exists() else {"format": "demc-exr 1", "scenes": []}
    known = {scene["name"] for scene in listed["scenes"]}
    width, height = map(int, options.size.split("x"))
    for number in numbers:
        name = f"{options.renderer}-{number}"
        if name in known:
            continue
        write(options.output / options.split / f"{name}.exr", view(options.renderer, number, options))
        about = {"name": name, "split": options.split, "base": f"stock-{number}", "file": f"{options.split}/{name}.exr", "width": width, "height": height}
        about |= {"spp": options.spp, "ref_spp": options.ref_spp, "renderer": options.renderer}
        listed["scenes"] += [about] + [about | {"name": f"{name}-copy-{copy}"} for copy in range(2, options.copies + 1)]
        manifest.write_text(json.dumps(listed, indent=1))
        print(name, flush=True)


if __name__ == "__main__":
    main()
