#!/usr/bin/env python3
"""Compares the Python package with the command line: time and memory of the same work.

    python3 benches/borders.py --python .venv/bin/python [--rounds 7]

Each round denoises one frame of 1920x1080 pixels with each program, in turn. The programs read and
write the same OpenEXR file. The Python program needs the wheel, NumPy, and OpenEXR. The table has medians, and
the median and quartiles of the ratios of each round. Memory is the largest resident set.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "data/sample/test/col-classroom-1.exr"
HEIGHT, WIDTH = 1080, 1920

FRAME = """
import sys, numpy as np, OpenEXR
source, target, height, width = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
with OpenEXR.File(source, separate_channels=True) as file:
    channels = {name: np.resize(np.tile(channel.pixels, (8, 8)), (height, width)) for name, channel in file.channels().items()
                if not name.startswith("ref.")}
OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(target)
"""
"""Makes the frame: the sample, repeated."""

DENOISE = """
import sys, demc, numpy as np, OpenEXR
source, target = sys.argv[1:]
with OpenEXR.File(source, separate_channels=True) as file:
    header, channels = file.header(), {name: channel.pixels for name, channel in file.channels().items()}
image = lambda names: np.stack([channels[name].astype(np.float32) for name in names])
group = lambda layer, ends: image([f"{layer}.{end}" for end in ends])
clean = demc.denoise(image("RGB"), normal=group("normal", "XYZ"), position=group("position", "XYZ"),
                     albedo=group("albedo1", "RGB"), albedo2=group("albedo2", "RGB"))
channels |= {name: plane.astype(np.float16) for name, plane in zip("RGB", clean)}
OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(target)
"""
"""The work of the command line in Python."""


def measured(command: list[str]) -> tuple[float, float]:
    """Seconds and largest resident set in MiB of a program."""
    start = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.monotonic() - start
    if status:
        sys.exit(f"{command[0]}: {process.stderr.read().decode()}")
    return seconds, usage.ru_maxrss / 1024


def spread(values: list[float], form: str) -> str:
    """Median and quartiles."""
    low, middle, high = statistics.quantiles(values, n=4)
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default=sys.executable, metavar="FILE", help="Python with the wheel [this one]")
    parser.add_argument("--program", default=str(ROOT / "target/release/demc-infer"), metavar="FILE", help="[target/release/demc-infer]")
    parser.add_argument("--rounds", type=int, default=7, metavar="N", help="[7]")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        frame = f"{folder}/frame.exr"
        subprocess.run([args.python, "-c", FRAME, str(SAMPLE), frame, str(HEIGHT), str(WIDTH)], check=True)
        denoise = ["denoise", frame, "-o", f"{folder}/out.exr", "--overwrite"]
        programs = {
            "command line": [args.program, *denoise],
            "the wheel's `demc-infer`": [str(Path(args.python).parent / "demc-infer"), *denoise],
            "`demc.denoise`, files by OpenEXR": [args.python, "-W", "ignore", "-c", DENOISE, frame, f"{folder}/python.exr"],
        }
        runs: dict[str, list[tuple[float, float]]] = {name: [] for name in programs}
        for _ in range(args.rounds):
            for name, command in programs.items():
                runs[name].append(measured(command))
    first = next(iter(runs.values()))
    print("| program | s | MiB | time ratio | memory ratio |\n|---|---:|---:|---:|---:|")
    for name, own in runs.items():
        seconds, memory = (statistics.median(run[i] for run in own) for i in (0, 1))
        ratios = [[mine[i] / theirs[i] for mine, theirs in zip(own, first)] for i in (0, 1)]
        print(f"| {name} | {seconds:.2f} | {memory:.0f} | {spread(ratios[0], '.3f')} | {spread(ratios[1], '.3f')} |")


if __name__ == "__main__":
    main()
