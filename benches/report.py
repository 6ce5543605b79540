"""Times `demc-infer report` on 20 images of 1280x720, mosaics of the sample's scenes. Programs take turns.

    pip install numpy OpenEXR
    python benches/report.py target/release/demc-infer [OTHER/demc-infer] [--rounds 3]
"""

import argparse
import json
import random
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenEXR

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "sample"
IMAGES, HEIGHT, WIDTH, TILE = 20, 720, 1280, 224


def mosaics(folder: Path) -> None:
    """Writes a data set of `IMAGES` test scenes, each made of random tiles of the sample's scenes."""
    manifest = json.loads((SAMPLE / "manifest.json").read_text())
    tiles = []
    for scene in manifest["scenes"]:
        channels = OpenEXR.File(str(SAMPLE / scene["file"]), separate_channels=True).channels()
        tiles.append({name: channel.pixels for name, channel in channels.items()})
    names, rng, scenes = set.intersection(*map(set, tiles)), random.Random(1), []
    for number in range(IMAGES):
        kinds = {name: np.float32 if name.startswith("position") else np.float16 for name in names}
        image = {name: np.zeros((HEIGHT, WIDTH), kind) for name, kind in kinds.items()}
        for y in range(0, HEIGHT, TILE):
            for x in range(0, WIDTH, TILE):
                tile = rng.choice(tiles)
                for name in names:
                    part = image[name][y : y + TILE, x : x + TILE]
                    part[:] = tile[name][: part.shape[0], : part.shape[1]]
        name = f"mosaic-{number}"
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, image).write(str(folder / f"{name}.exr"))
        own = {"name": name, "base": name, "split": "test", "file": f"{name}.exr", "width": WIDTH, "height": HEIGHT}
        scenes.append(manifest["scenes"][0] | own)
    (folder / "manifest.json").write_text(json.dumps(manifest | {"scenes": scenes}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("programs", nargs="+", metavar="PROGRAM")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    seconds: dict[str, list[float]] = {program: [] for program in args.programs}
    with tempfile.TemporaryDirectory() as folder:
        mosaics(Path(folder))
        page = Path(folder) / "report.html"
        for _ in range(args.rounds):
            for program, times in seconds.items():
                page.unlink(missing_ok=True)
                start = time.monotonic()
                subprocess.run([program, "report", "--data", folder, "-o", page, "--overwrite"], check=True, capture_output=True)
                times.append(time.monotonic() - start)
        size = page.stat().st_size
    for program, times in seconds.items():
        print(f"{program}: {statistics.median(times):.1f} s ({min(times):.1f} to {max(times):.1f}), {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
