"""Manifest and EXR files of a data set, for the other tools in this folder."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import OpenEXR

# The package of this checkout: its reader needs neither an installation nor PyTorch.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bindings" / "python"))

from demc.torch.exr import Frame, write_whole
from demc.torch.files import write_json


def add_layout_flags(parser: argparse.ArgumentParser) -> None:
    """`--layout` and `--layer`, as in `demc-infer`."""
    parser.add_argument(
        "--layout",
        metavar="PRESET|FILE",
        help="channel layout: demc-exr, mitsuba3, pbrt-v4, cycles, fbksd, or a TOML file; default: per file, the preset that fits",
    )
    parser.add_argument("--layer", metavar="NAME", help="view layer, for files with several")


def pixels(planes: np.ndarray) -> np.ndarray:
    """[C, H, W] -> [H, W, C]."""
    return np.ascontiguousarray(planes.transpose(1, 2, 0))


def albedo(frame: Frame) -> np.ndarray:
    """Albedo (first hit) [H, W, 3]."""
    return pixels(frame.features[6:9])


def normal(frame: Frame) -> np.ndarray:
    """Normal [H, W, 3]."""
    return pixels(frame.features[:3])


def reference(frame: Frame) -> np.ndarray:
    """Reference [H, W, 3]. Raises ValueError for a file without."""
    if frame.reference is None:
        raise ValueError(f"{frame.file.path}: no reference channels of layout {frame.layout.name}")
    return pixels(frame.reference)


def manifest(data: Path) -> dict:
    return json.loads((data / "manifest.json").read_text())


def scenes(data: Path, split: str) -> list[Path]:
    """The files of a split, as the manifest lists them."""
    found = [data / scene["file"] for scene in manifest(data)["scenes"] if scene["split"] == split]
    if not found:
        raise ValueError(f"{data / 'manifest.json'}: no scenes in split {split}")
    return found


def write(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Writes an EXR file completely or not at all."""
    write_whole(path, OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels))


def write_manifest(data: Path, manifest: dict) -> None:
    write_json(data / "manifest.json", manifest)
