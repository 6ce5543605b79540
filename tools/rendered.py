"""What rendered views of every renderer have in common: brightness, noise, files, and the manifest."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import OpenEXR

# The package of this checkout.
sys.path.append(str(Path(__file__).resolve().parents[1] / "bindings" / "python"))

from demc.torch.exr import write_whole
from demc.torch.files import write_json, write_text

LUMINANCE = 0.22
"""Mean luminance after scaling, without the brightest pixels."""
TRIMMED = 0.02
"""Share of the brightest pixels that the mean excludes."""
EPSILON = 0.001
"""Epsilon of RelMSE (Eq. 5)."""
CLAMP = 45.0
"""Upper limit of a sample, in units of the mean luminance."""
GUIDES = ("normal", "albedo1")
"""Features of the reference's own samples that are written, for `tools/references.py`."""
USUAL = 4
"""Samples per pixel that the limits on noise are for."""
LEFT_OUT = ".left-out"
"""Ending of the file that has the reason why a view was left out."""
CHANNELS = {
    "color": ("", "RGB"),
    "normal": ("normal.", "XYZ"),
    "position": ("position.", "XYZ"),
    "albedo1": ("albedo1.", "RGB"),
    "albedo2": ("albedo2.", "RGB"),
    "mask": ("mask.", "A"),
    "depth": ("depth.", "Z"),
    "diffuse": ("diffuse.", "RGB"),
    "specular": ("specular.", "RGB"),
}
"""Start and ends of each buffer's channel names."""
COUNTS = [1, 2, 4, 8, 16, 32, 64, 128, 256]
"""The usual numbers of samples per pixel."""
REPEATS = {16: 2, 64: 6}
"""How often an epoch takes the images of at least so many samples per pixel: with --counts, they are few."""
REFERENCE_SHARE = 4
"""A reference has at least this many times the samples of the noisy image, or a residual below this part of its noise."""
TEST = {"views": 1, "size": 192, "residual": 0.0, "split": "test"}
"""Options of test views."""
HELD_OUT = TEST | {"spp": COUNTS[::2], "ref_spp": 2048, "edition": "heldout"}
"""Options of the held-out scenes of the bundled models."""


class Unsuitable(Exception):
    """The view is useless for training."""


def brightness(color: np.ndarray) -> float:
    """Mean luminance of `[H, W, 3]` without the brightest pixels."""
    luminance = np.sort((color @ [0.2126, 0.7152, 0.0722]).ravel())
    mean = luminance[: int(len(luminance) * (1 - TRIMMED))].mean()
    if not mean > 1e-4:
        raise Unsuitable("dark")
    return mean


def rel_mse(difference: np.ndarray, reference: np.ndarray) -> float:
    """Eq. 5, summed over rgb."""
    return float((difference**2 / (reference**2 + EPSILON)).mean() * 3)


def file_channels(buffers: dict[str, np.ndarray], scaled: bool) -> dict[str, np.ndarray]:
    """The channels of a file, `[H, W]` each: half floats where they are exact enough.

    `scaled`: radiance may be too bright or too dark for half floats.
    """
    channels = {}
    for buffer, planes in buffers.items():
        before, _, name = buffer.rpartition(".")
        before += "." if before else ""
        prefix, ends = CHANNELS[name]
        coarse = (
            before == "variance."
            or (name in ("position", "depth") and too_coarse(planes))
            or (name == "color" and scaled)
        )
        kind = np.float32 if coarse else np.float16
        limit = np.finfo(kind).max
        for i, end in enumerate(ends):
            channels[before + prefix + end] = np.ascontiguousarray(planes[..., i].clip(-limit, limit).astype(kind))
    return channels


def too_coarse(position: np.ndarray) -> bool:
    """Whether the step of a 16-bit float exceeds a thousandth of the visible extent."""
    step = float(np.spacing(np.float16(min(np.abs(position).max(), 6e4))))
    return np.abs(position).max() > 6e4 or step > np.ptp(position, axis=(0, 1)).max() / 1000


def write(path: Path, channels: dict[str, np.ndarray], entry: dict) -> None:
    """Writes the EXR file completely or not at all. Its header contains the manifest's entry."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "demc": json.dumps(entry)}
    write_whole(path, OpenEXR.File(header, channels))


def entry_of(path: Path) -> dict:
    """The manifest's entry in a file's header."""
    with OpenEXR.File(str(path), header_only=True) as file:
        return json.loads(file.header()["demc"])


def repeat(spp: int) -> int:
    """How often an epoch takes an image of so many samples per pixel."""
    return max((times for least, times in REPEATS.items() if spp >= least), default=1)


def drawn_counts(args: argparse.Namespace, rng: np.random.Generator) -> list[int]:
    """The numbers of samples per pixel of a view's noisy images, in order.

    One is drawn for the reference to serve, large ones less often because they cost most. The
    others are drawn from all that this reference serves, too.
    """
    if not args.counts:
        return args.spp
    chances = np.cbrt(1 / np.array(args.spp))
    served = int(rng.choice(args.spp, p=chances / chances.sum()))
    limit = max(served, args.ref_spp // REFERENCE_SHARE)
    others = [count for count in args.spp if count <= limit and count != served]
    return sorted([served, *map(int, rng.choice(others, min(args.counts - 1, len(others)), replace=False))])


def files_of(name: str, counts: list[int], args: argparse.Namespace) -> dict[int, str]:
    """The names of a view's files, by number of samples per pixel."""
    return {count: name if args.spp == [count] else f"{name}-{count}spp" for count in counts}


def make_view(
    args: argparse.Namespace,
    name: str,
    place: dict,
    files: Iterable[str],
    renderer: str,
    photograph: Callable[[], list[tuple[dict, dict]]],
) -> None:
    """Writes the images of a view, or why it is left out, and the manifest.

    `photograph` returns channels and facts of each of `files`. `place` has the `base` and, if any, the `kind` of the view.
    """
    start, said = time.monotonic(), []
    folder = args.output / args.split
    try:
        for (channels, facts), file in zip(photograph(), files):
            entry = {"name": file, "split": args.split, "base": place["base"], "file": f"{args.split}/{file}.exr"} | place
            if args.counts:
                entry["repeat"] = repeat(facts["spp"])
            write(folder / f"{file}.exr", channels, entry | facts)
            said.append("RelMSE {noisy_relmse:.2f} at {spp} spp".format(**facts))
        said.append("reference {ref_residual_relmse:.4f} at {ref_spp} spp".format(**facts))
    except Unsuitable as reason:
        write_text(folder / f"{name}{LEFT_OUT}", str(reason))
        said = [f"left out: {reason}"]
    write_manifest(args, renderer)
    print(f"{name}: {', '.join(said)}, {time.monotonic() - start:.0f} s", flush=True)


def left_out(output: Path) -> dict[str, str]:
    """The reason for each view that was left out, from the manifest and from files of all workers."""
    manifest = output / "manifest.json"
    listed = json.loads(manifest.read_text()).get("left_out", {}) if manifest.exists() else {}
    return listed | {path.stem: path.read_text() for path in sorted(output.glob(f"*/*{LEFT_OUT}"))}


def write_manifest(args: argparse.Namespace, renderer: str) -> None:
    """Lists all rendered scenes and those of `--with`. A shard leaves that to the command without."""
    if args.shard:
        return
    scenes = [entry_of(path) for path in sorted(args.output.glob("*/*.exr"))]
    for other in args.beside:
        listed = json.loads((other / "manifest.json").read_text())
        theirs = {"renderer": listed["renderer"]} if "renderer" in listed else {}
        for entry in listed["scenes"]:
            file = os.path.relpath((other / entry["file"]).resolve(), args.output.resolve())
            scenes.append(theirs | entry | {"file": file})
    manifest = {"format": "demc-exr 1", "renderer": renderer, "scenes": scenes, "left_out": left_out(args.output)}
    write_json(args.output / "manifest.json", manifest)


def run(main: Callable[[], None]) -> None:
    """Runs a program: a file that cannot be read or written ends it with one line."""
    try:
        main()
    except BrokenPipeError:
        # The reader of the progress has seen enough. Files are whole, and the next run resumes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        sys.exit(f"error: {error}")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """The options of every renderer."""
    parser.add_argument("--spp", type=numbers, default=[4], metavar="N,...", help="samples per pixel of the noisy images [4]")
    parser.add_argument("--counts", type=int, metavar="N", help="largest number of noisy images per view, drawn from --spp [all]")
    parser.add_argument("--ref-spp", type=int, default=128, metavar="N", help="largest number of samples per pixel of the reference [128]")
    parser.add_argument("--residual", type=float, default=0.03, metavar="X", help="expected RelMSE at which a reference is good enough [0.03]")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of scenes and samples [1]")
    parser.add_argument("--split", choices=("train", "test"), default="train", help="split of the rendered views [train]")
    parser.add_argument("--with", dest="beside", action="append", default=[], type=Path, metavar="DIR", help="data set whose scenes are also listed; can be repeated")


def numbers(text: str) -> list[int]:
    """Rising positive numbers: `1,4,16`."""
    found = sorted({int(part) for part in text.split(",")})
    if found[0] < 1:
        raise ValueError
    return found
