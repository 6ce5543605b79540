#!/usr/bin/env python3
"""Compares time and memory with those of Open Image Denoise (OIDN).

    pip install numpy OpenEXR pyoidn dist/demc-*.whl
    python benches/oidn.py [--rounds 7]     # the bundled models, 1920x1080
    python benches/oidn.py --networks       # OIDN's own networks in both programs, 1920x1080 and 3840x2160

Both denoise an image in memory with as many threads as there are processors. Each round measures each
program in a process of its own, in turn: OIDN with its own `oidnBenchmark` (HDR colour, albedo, and
normal), its passes over albedo and normal alone, the models with `demc.denoise`, including albedo filter
and restored light. A process denoises once without a clock, and then three times, at 3840x2160 once. The
table has medians, and the median and quartiles of the ratios of each round.

Memory is the growth of a process's peak from the point where it has the images, once per program: for OIDN
with `pyoidn.denoise`, which has the output as `demc.denoise` does. It needs Linux.
"""

from __future__ import annotations

import argparse
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import pyoidn

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "data/sample/test/col-classroom-1.exr"
FULL_HD, UHD = (1080, 1920), (2160, 3840)
PAIRS = {"quality": "high", "fast": "fast"}
"""Bundled models, and the quality of OIDN that each is compared with."""

NETWORKS = {
    "rt_hdr_alb_nrm_small": ("fast", "hdr_alb_nrm"),
    "rt_hdr_alb_nrm": ("high", "hdr_alb_nrm"),
    "rt_hdr_calb_cnrm_large": ("high", "hdr_calb_cnrm"),
}
"""OIDN's weights, and the quality and images with which OIDN takes them."""

IMAGES = """
import sys, time, warnings, numpy as np, OpenEXR
warnings.simplefilter("ignore")
source, height, width = sys.argv[1], *map(int, sys.argv[2:4])
with OpenEXR.File(source, separate_channels=True) as file:
    channels = {name: channel.pixels.astype(np.float32) for name, channel in file.channels().items()}
def image(layer, ends):
    planes = [np.resize(np.tile(channels[layer + end], (1, 16)), (height, width)) for end in ends]
    return np.ascontiguousarray(np.stack(planes, axis=-1))
color, normal, position = image("", "RGB"), image("normal.", "XYZ"), image("position.", "XYZ")
albedo, albedo2 = image("albedo1.", "RGB"), image("albedo2.", "RGB")
def growth(denoise):
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # The peak is now the present size.
    before, = (int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
    denoise()
    after, = (int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
    return (after - before) / 1024
"""

DENOISE = IMAGES + """
import demc
name, passes = sys.argv[4], int(sys.argv[5])
def denoise():
    return demc.denoise(color, model=model, normal=normal, position=position, albedo=albedo, albedo2=albedo2)
def load():
    global model
    model = demc.Model.load(name)
    denoise()
mebibytes = growth(load)
start = time.perf_counter()
for _ in range(passes):
    denoise()
print((time.perf_counter() - start) / passes, mebibytes)
"""

PEER_MEMORY = IMAGES + """
import pyoidn
quality, clean = sys.argv[4], sys.argv[5] == "True"
print(growth(lambda: pyoidn.denoise(color, albedo=albedo, normal=normal, hdr=True, clean_aux=clean, quality=quality)))
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


def passes(size: tuple[int, int]) -> int:
    """Measured images of a process."""
    return 1 if size == UHD else 3


def run(code: str, *arguments: object) -> list[float]:
    """The numbers that a process with this code prints."""
    command = [sys.executable, "-W", "ignore", "-c", code, *arguments]
    return [float(word) for word in said(command).split()]


def said(command: list[object]) -> str:
    return subprocess.run([*map(str, command)], check=True, capture_output=True, text=True).stdout


def ours(model: object, size: tuple[int, int]) -> list[float]:
    """Seconds and MiB."""
    return run(DENOISE, SAMPLE, *size, model, passes(size))


def peer_memory(quality: str, images: str, size: tuple[int, int]) -> float:
    return run(PEER_MEMORY, SAMPLE, *size, quality, images == "hdr_calb_cnrm")[0]


def peer_seconds(quality: str, images: str, size: tuple[int, int]) -> float:
    program = Path(pyoidn.__file__).parent / "oidn/bin/oidnBenchmark"
    program.chmod(0o755)
    height, width = size
    command = [program, "-r", f"RT\\.{images}\\.{width}x{height}", "-q", quality, "-n", passes(size)]
    return float(re.search(r"([\d.]+) msec/image", said(command))[1]) / 1000


def guided_seconds(quality: str, size: tuple[int, int]) -> float:
    """OIDN with albedo and normal denoised first, for which it has networks of its own."""
    return run(GUIDES, ROOT / "tools", quality, *size, passes(size))[0] + peer_seconds(quality, "hdr_calb_cnrm", size)


def compared(mine: list[float], peer: list[float]) -> list[str]:
    """The peer's median, and median and quartiles of the ratios."""
    ratios = [own / other for own, other in zip(mine, peer)]
    low, _, high = statistics.quantiles(ratios, n=4) if len(ratios) > 1 else ratios * 3
    return [f"{statistics.median(peer):.2f}", f"{statistics.median(ratios):.2f} ({low:.2f} to {high:.2f})"]


def models(rounds: int) -> None:
    """Prints the table of the bundled models."""
    measured = [
        {
            model: (ours(model, FULL_HD)[0], peer_seconds(quality, "hdr_alb_nrm", FULL_HD), guided_seconds(quality, FULL_HD))
            for model, quality in PAIRS.items()
        }
        for _ in range(rounds)
    ]
    print("| model | s | OIDN | s | ratio | both denoised first, s | ratio |\n|---|---:|---|---:|---:|---:|---:|")
    for model, quality in PAIRS.items():
        mine, *peers = zip(*(one[model] for one in measured))
        cells = [model, f"{statistics.median(mine):.2f}", quality, *compared(mine, peers[0]), *compared(mine, peers[1])]
        print(f"| {' | '.join(cells)} |")


def networks(rounds: int) -> None:
    """Prints the table of OIDN's networks."""
    import demc

    library = next(Path(pyoidn.__file__).parent.rglob("libOpenImageDenoise_core.*"))
    print("| weights | image | s | OIDN, s | ratio | MiB | OIDN, MiB | ratio |\n|---|---|---:|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for size in (FULL_HD, UHD):
            for weights, (quality, images) in NETWORKS.items():
                model = Path(folder, f"{weights}.safetensors")
                if not model.exists():
                    demc.import_oidn(library, model, weights=weights)
                measured = [(*ours(model, size), peer_seconds(quality, images, size)) for _ in range(rounds)]
                mine, mebibytes, peer = map(list, zip(*measured))
                memory = [peer_memory(quality, images, size) for _ in range(rounds)]
                cells = [f"`{weights}`", f"{size[1]}x{size[0]}", f"{statistics.median(mine):.2f}", *compared(mine, peer)]
                ratio = statistics.median(mebibytes) / statistics.median(memory)
                cells += [f"{statistics.median(mebibytes):.0f}", f"{statistics.median(memory):.0f}", f"{ratio:.2f}"]
                print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7, metavar="N", help="rounds [7]")
    parser.add_argument("--networks", action="store_true", help="compare OIDN's own networks in both programs")
    args = parser.parse_args()
    (networks if args.networks else models)(args.rounds)


if __name__ == "__main__":
    main()
