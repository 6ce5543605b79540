#!/usr/bin/env python3
"""Compares the time of the bundled models with that of Open Image Denoise (OIDN) at 1920x1080.

    pip install numpy OpenEXR pyoidn dist/demc-*.whl
    python benches/oidn.py [--rounds 7]

Both denoise an image in memory with as many threads as there are processors. Each round measures each
program in a process of its own, in turn: OIDN with its own `oidnBenchmark` (HDR colour, albedo, and
normal), its passes over albedo and normal alone, the models with `demc.denoise`, including albedo filter
and restored light. A process denoises once without a clock, and then three times. The table has medians,
and the median and quartiles of the ratios of each round.
"""

from __future__ import annotations

import argparse
import re
import statistics
import subprocess
import sys
from pathlib import Path

import pyoidn

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "data/sample/test/col-classroom-1.exr"
HEIGHT, WIDTH, PASSES = 1080, 1920, 3
PAIRS = {"quality": "high", "fast": "fast"}
"""Bundled models, and the quality of OIDN that each is compared with."""

DENOISE = """
import sys, time, demc, numpy as np, OpenEXR
source, name, height, width, passes = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:])
with OpenEXR.File(source, separate_channels=True) as file:
    channels = {name: np.resize(np.tile(channel.pixels.astype(np.float32), (8, 8)), (height, width)) for name, channel in file.channels().items()}
group = lambda layer, ends: np.stack([channels[layer + end] for end in ends])
features = {"normal": group("normal.", "XYZ"), "position": group("position.", "XYZ"), "albedo": group("albedo1.", "RGB"), "albedo2": group("albedo2.", "RGB")}
color, model = group("", "RGB"), demc.Model.load(name)
times = []
for _ in range(passes + 1):
    start = time.perf_counter()
    model.denoise(color, **features)
    times.append(time.perf_counter() - start)
print(sum(times[1:]) / passes)
"""

GUIDES = """
import sys, time, numpy as np
sys.path.insert(0, sys.argv[1])
from oidn import feature_filter
quality, height, width, passes = sys.argv[2], *map(int, sys.argv[3:])
feature = np.random.default_rng(1).random((height, width, 3), np.float32)
seconds = 0
for kind in ("albedo", "normal"):
    with feature_filter(kind, feature, np.empty_like(feature), quality) as filter:
        filter.execute()
        start = time.perf_counter()
        for _ in range(passes):
            filter.execute()
        seconds += (time.perf_counter() - start) / passes
print(seconds)
"""


def seconds_of(code: str, *arguments: object) -> float:
    command = [sys.executable, "-W", "ignore", "-c", code, *arguments, HEIGHT, WIDTH, PASSES]
    return float(subprocess.run([*map(str, command)], check=True, capture_output=True, text=True).stdout)


def model_seconds(name: str) -> float:
    return seconds_of(DENOISE, SAMPLE, name)


def guided_seconds(quality: str) -> float:
    """OIDN with albedo and normal denoised first, for which it has networks of its own."""
    return seconds_of(GUIDES, ROOT / "tools", quality) + oidn_seconds(quality, "hdr_calb_cnrm")


def oidn_seconds(quality: str, images: str = "hdr_alb_nrm") -> float:
    program = Path(pyoidn.__file__).parent / "oidn/bin/oidnBenchmark"
    program.chmod(0o755)
    command = [program, "-r", f"RT\\.{images}\\.{WIDTH}x{HEIGHT}", "-q", quality, "-n", PASSES]
    said = subprocess.run([*map(str, command)], check=True, capture_output=True, text=True).stdout
    return float(re.search(r"([\d.]+) msec/image", said)[1]) / 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7, metavar="N", help="rounds [7]")
    args = parser.parse_args()
    rounds = [
        {model: (model_seconds(model), oidn_seconds(quality), guided_seconds(quality)) for model, quality in PAIRS.items()}
        for _ in range(args.rounds)
    ]
    print("| model | s | OIDN | s | ratio | both denoised first, s | ratio |\n|---|---:|---|---:|---:|---:|---:|")
    for model, quality in PAIRS.items():
        ours, *peers = zip(*(measured[model] for measured in rounds))
        cells = [model, f"{statistics.median(ours):.2f}", quality]
        for theirs in peers:
            ratios = [mine / other for mine, other in zip(ours, theirs)]
            low, _, high = statistics.quantiles(ratios, n=4) if len(ratios) > 1 else ratios * 3
            cells += [f"{statistics.median(theirs):.2f}", f"{statistics.median(ratios):.2f} ({low:.2f} to {high:.2f})"]
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
