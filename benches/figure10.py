"""Times the denoisers of the paper's comparison (Sec. 4.5) at 1280x720, in turns.

    pip install numpy OpenEXR pyoidn
    python benches/figure10.py --data data/comparison [--rounds 3]

DEMC has the paper's 64 channels and KPCN its 100; one training step gives them weights, which do not change
the time. Each is a process of `demc-infer denoise`, from file to file, as NFOR is. The image is a test view,
repeated until it has the size. Open Image Denoise (OIDN) runs in its own `oidnBenchmark`, without files.
"""

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import OpenEXR
from oidn import ROOT, peer_seconds, said

PROGRAMS = ROOT / "target" / "release"
HEIGHT, WIDTH = 720, 1280
NETWORKS = {"DEMC": "demc", "KPCN": "kpcn"}
"""The configurations of `configs/paper`."""


def seconds(*command: object) -> float:
    start = time.monotonic()
    said([*command])
    return time.monotonic() - start


def enlarged(source: Path, target: Path) -> None:
    """Writes the image with all its channels, repeated until it has the size."""
    with OpenEXR.File(str(source), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    repeats = [-(-side // old) for side, old in zip((HEIGHT, WIDTH), next(iter(channels.values())).shape)]
    image = {name: np.ascontiguousarray(np.tile(plane, repeats)[:HEIGHT, :WIDTH]) for name, plane in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, image) as file:
        file.write(str(target))


def trained(variant: str, folder: Path) -> Path:
    """The run directory of one training step on the data set of the folder."""
    run = folder / variant
    settings = [f"data.root={folder}", "data.batch_size=1", "data.validation=0", "train.steps=1", "loss.separate=0"]
    sets = [word for setting in settings for word in ("--set", setting)]
    said([PROGRAMS / "demc-train", "--config", ROOT / f"configs/paper/{variant}.toml", *sets, "--run-dir", run])
    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="data set of `tools/render --passes paper`")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="rounds [3]")
    args = parser.parse_args()
    manifest = json.loads((args.data / "manifest.json").read_text())
    view = next(scene for scene in manifest["scenes"] if scene["split"] == "test")
    file = (args.data / view["file"]).resolve()
    single = manifest | {"scenes": [view | {"split": "train", "file": str(file)}]}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        image, output = folder / "image.exr", folder / "output.exr"
        (folder / "manifest.json").write_text(json.dumps(single))
        enlarged(file, image)
        models = {name: ["--model", trained(variant, folder)] for name, variant in NETWORKS.items()}
        denoise = PROGRAMS / "demc-infer", "denoise", image, "-o", output, "--overwrite"
        ways = {name: (lambda how=how: seconds(*denoise, *how)) for name, how in (models | {"NFOR": ["--filter", "nfor"]}).items()}
        ways["OIDN, `high`"] = lambda: peer_seconds("high", "hdr_alb_nrm", (HEIGHT, WIDTH))
        rounds = [{name: way() for name, way in ways.items()} for _ in range(args.rounds)]
    print("| denoiser | s | times DEMC's (least to most) |\n|---|---:|---:|")
    for name in ways:
        ratios = [one[name] / one["DEMC"] for one in rounds]
        spread = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        print(f"| {name} | {statistics.median(one[name] for one in rounds):.2f} | {spread} |")


if __name__ == "__main__":
    main()
