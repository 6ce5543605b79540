"""Manifest and EXR files of a data set, for the other tools in this folder."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import OpenEXR


class Scene:
    """The channels of an EXR file, and the scene's entry in its header."""

    def __init__(self, path: Path) -> None:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            self.channels = {name: channel.pixels for name, channel in file.channels().items()}
            self.about = {key: value for key, value in file.header().items() if key == "demc"}
        self.path = path

    def rgb(self, prefix: str, names: str = "RGB") -> np.ndarray:
        """Three channels as float32 [H, W, 3]."""
        wanted = [prefix + name for name in names]
        missing = [name for name in wanted if name not in self.channels]
        if missing:
            raise ValueError(f"{self.path}: no channel {', '.join(missing)}")
        return np.ascontiguousarray(np.stack([self.channels[name] for name in wanted], -1), np.float32)


def manifest(data: Path) -> dict:
    return json.loads((data / "manifest.json").read_text())


def scenes(data: Path, split: str) -> list[Path]:
    """The files of a split, as the manifest lists them."""
    found = [data / scene["file"] for scene in manifest(data)["scenes"] if scene["split"] == split]
    if not found:
        raise ValueError(f"{data / 'manifest.json'}: no scenes in split {split}")
    return found


def as_kind(plane: np.ndarray, kind: np.dtype) -> np.ndarray:
    """The plane in another float type; too large values become the largest finite one."""
    limit = np.finfo(kind)
    return np.ascontiguousarray(plane.clip(limit.min, limit.max).astype(kind))


def write(path: Path, channels: dict[str, np.ndarray], about: dict[str, str] | None = None) -> None:
    """Writes an EXR file completely or not at all."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | (about or {})
    unfinished = path.with_name(f".{path.stem}.unfinished.exr")
    OpenEXR.File(header, channels).write(str(unfinished))
    os.replace(unfinished, path)


def write_manifest(data: Path, manifest: dict) -> None:
    unfinished = data / ".manifest.json.unfinished"
    unfinished.write_text(json.dumps(manifest, indent=1))
    os.replace(unfinished, data / "manifest.json")
