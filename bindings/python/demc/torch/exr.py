"""Reads the buffers of a renderer's EXR file, and writes the file with another colour. No PyTorch."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from .files import replacing
from .layouts import BUFFERS, MISSING, Layout, choose, either, printable, require

LOSSLESS = ("NO_COMPRESSION", "RLE_COMPRESSION", "ZIPS_COMPRESSION", "ZIP_COMPRESSION", "PIZ_COMPRESSION")
"""Compressions that keep all bits of all channels. `ExrFile.write` replaces others by ZIP."""
PRECISIONS = {"half": np.float16, "float": np.float32}


@dataclass(frozen=True)
class Channel:
    """A channel of a file."""

    part: int
    name: str  # in its part
    pixels: np.ndarray  # [H, W], of the file's type


class ExrFile:
    """A decoded file: the parts, and their channels by name.

    In a file of several parts, a channel is called `Part.channel`; a name that starts with that of
    its part stays. Raises OSError if the file cannot be read, and ValueError if it is damaged.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = Path(path)
        with open(path, "rb"):
            pass  # OpenEXR's error does not say why a file cannot be opened.
        try:
            self.parts = OpenEXR.File(str(path), separate_channels=True).parts
            # OpenEXR from 3.4 on leaves out parts that it cannot decode.
            expected = len(OpenEXR.File(str(path), header_only=True).parts)
        except (RuntimeError, ValueError, TypeError) as error:
            raise ValueError(f"{path}: not a readable OpenEXR file: {' '.join(str(error).split())}") from error
        if len(self.parts) < max(expected, 1):
            raise ValueError(f"{path}: not a readable OpenEXR file: damaged or cut short")
        self.channels: dict[str, Channel] = {}
        for index, part in enumerate(self.parts):
            layer = part.header.get("name", "") if len(self.parts) > 1 else ""
            for name, channel in part.channels.items():
                if channel.pixels.dtype == object or (channel.xSampling, channel.ySampling) != (1, 1):
                    unsupported = "deep and subsampled channels are not supported"
                    raise ValueError(f"{path}: channel {printable(name)}: {unsupported}")
                full = name if not layer or name.startswith(f"{layer}.") else f"{layer}.{name}"
                self.channels.setdefault(printable(full), Channel(index, name, channel.pixels))

    def planes(self, names: Iterable[str]) -> np.ndarray:
        """The named channels [C, H, W] as float32. Raises ValueError for missing channels and different sizes."""
        names = list(names)
        require(self.path, names, self.channels)
        first = self.window(names[0])
        for name in names[1:]:
            if (other := self.window(name)) != first:
                raise ValueError(f"{self.path}: buffers of different sizes: {names[0]} is {first}, {name} is {other}")
        return np.stack([self.channels[name].pixels.astype(np.float32) for name in names])

    def window(self, name: str) -> str:
        """The pixels that a channel covers: WxH, or WxH+X+Y away from the origin."""
        channel = self.channels[name]
        left, top = self.parts[channel.part].header["dataWindow"][0]
        height, width = channel.pixels.shape
        return f"{width}x{height}" + (f"{left:+}{top:+}" if left or top else "")

    def write(self, path: str | os.PathLike, planes: Mapping[str, np.ndarray], precision: str | None = None) -> None:
        """Writes a copy of the file with other `planes` [H, W] for some of its channels.

        Parts, attributes, and all other channels stay. Replaced channels have the type `precision`:
        "half", "float", or by default that of the file (float instead of uint). Lossy compression
        becomes ZIP. The output is complete or absent.
        """
        if precision not in (None, *PRECISIONS):
            raise ValueError(f"precision {precision!r}: expected {' or '.join(PRECISIONS)}")
        replaced = {(self.channels[name].part, self.channels[name].name): plane for name, plane in planes.items()}
        parts = []
        for index, part in enumerate(self.parts):
            header, channels = dict(part.header), {}
            if header["compression"].name not in LOSSLESS:
                header["compression"] = OpenEXR.ZIP_COMPRESSION
            if (tiles := header.get("tiles")) is not None:
                # Without smaller levels, which would show the noise.
                header["tiles"] = OpenEXR.TileDescription()
                header["tiles"].xSize, header["tiles"].ySize = tiles.xSize, tiles.ySize
            for name, old in part.channels.items():
                pixels = old.pixels
                if (new := replaced.get((index, name))) is not None:
                    if new.shape != pixels.shape:
                        raise ValueError(f"{self.path}: channel {name} is {list(pixels.shape)}, not {list(new.shape)}")
                    own = np.float16 if pixels.dtype == np.float16 else np.float32
                    pixels = as_kind(new, PRECISIONS[precision] if precision else own)
                channels[name] = OpenEXR.Channel(pixels, 1, 1, old.pLinear)
            parts.append(OpenEXR.Part(header, channels, header.get("name", "")))
        write_whole(Path(path), OpenEXR.File(parts))


@dataclass
class Frame:
    """An image and its buffers in the renderer's units."""

    color: np.ndarray  # [3, H, W] float32: linear radiance, not negative
    features: np.ndarray  # [12, H, W] float32: normal, position, albedo (first hit), albedo (second hit)
    layout: Layout  # without the buffers that the file lacks
    file: ExrFile

    @cached_property
    def reference(self) -> np.ndarray | None:
        """Reference colour [3, H, W] float32, if the file has it: linear radiance, not negative.

        Raises ValueError as `read_exr`, which does not look at the reference.
        """
        names = self.layout.channels.get("reference")
        if names is None:
            return None
        planes = self.file.planes([self.layout.channels["color"][0], *names])[1:]
        check_finite(self.file.path, names, planes)
        return planes.clip(0)

    def layers(self, *patterns: str) -> dict[str, np.ndarray]:
        """The channels [H, W] whose names match glob patterns, as float32, without those of the colour.

        Raises ValueError for a pattern that matches nothing, and for a channel that is an input of
        the network, has integers or another size, or holds NaN or infinite values.
        """
        path, channels = self.file.path, self.file.channels
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in channels):
                raise ValueError(f"{path}: no channel matches {pattern}; the file has {', '.join(channels)}")
        color = self.layout.channels["color"]
        matching = (name for name in channels if any(fnmatchcase(name, pattern) for pattern in patterns))
        names = [name for name in matching if name not in color]
        for name in names:
            buffer = next((buffer for buffer in BUFFERS if name in self.layout.channels.get(buffer, ())), None)
            if buffer is not None:
                raise ValueError(f"{path}: channel {name} is no layer: it is the {buffer} that the network sees")
            if channels[name].pixels.dtype == np.uint32:
                raise ValueError(f"{path}: channel {name} is no layer: its type is uint, not half or float")
        planes = self.file.planes([color[0], *names])[1:]
        check_finite(path, names, planes)
        return dict(zip(names, planes))

    def write(
        self,
        path: str | os.PathLike,
        image: np.ndarray,
        precision: str | None = None,
        layers: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Writes the file with `image` [3, H, W] in place of its colour, and other `layers` [H, W] (`ExrFile.write`)."""
        if image.shape != self.color.shape:
            raise ValueError(f"image is {list(image.shape)}: expected {list(self.color.shape)}")
        planes = dict(zip(self.layout.channels["color"], image)) | dict(layers or {})
        self.file.write(path, planes, precision)


def read_exr(
    path: str | os.PathLike,
    layout: str | None = None,
    layer: str | None = None,
    bundle: Any = None,
    missing: Mapping[str, str] | None = None,
) -> Frame:
    """Reads an image of any renderer.

    `layout` is a preset or a TOML file. By default it is that of `bundle` (a `Bundle` or its `meta`)
    if it fits, otherwise the preset that fits. `layer` is the view layer, for a file with several.
    `missing` has policies for buffers that the file may lack; by default, zeros replace the position
    and the first albedo replaces the second one.

    Negative radiance becomes 0, and so does a position with three infinite coordinates. Raises
    OSError if the file cannot be read. Raises ValueError for a mistake in the layout, missing
    channels, different sizes, NaN, and infinite values.
    """
    meta = getattr(bundle, "meta", bundle)
    own = meta.get("layout") if meta else None
    policies = MISSING if own is None else either(dict.fromkeys(BUFFERS, "error") | own.get("missing", {}), MISSING)
    file = ExrFile(path)
    chosen = choose(file.path, file.channels, layout, layer, policies | dict(missing or {}), own)

    wanted = {"color": chosen.channels["color"]}
    for buffer in BUFFERS:
        names = chosen.channels.get(buffer, ())
        # If one of three channels is present, the buffer counts as present.
        if names and (chosen.missing[buffer] == "error" or any(name in file.channels for name in names)):
            wanted[buffer] = names
    names = [name for buffer in wanted.values() for name in buffer]
    planes = file.planes(names)
    found = {buffer: planes[3 * index : 3 * index + 3] for index, buffer in enumerate(wanted)}
    if (position := found.get("position")) is not None:
        position[:, np.isinf(position).all(0)] = 0  # LuxCore's, where a camera ray hits nothing.
    check_finite(file.path, names, planes)

    for buffer in BUFFERS:
        if buffer not in found:
            copied = chosen.missing[buffer] == "copy-texture1"
            found[buffer] = found["texture1"] if copied else np.zeros_like(found["color"])
    return Frame(
        color=found["color"].clip(0),
        features=np.concatenate([found[buffer] for buffer in BUFFERS]),
        layout=chosen.present(file.channels),
        file=file,
    )


def check_finite(path: Path, names: Iterable[str], planes: np.ndarray) -> None:
    """Raises ValueError with the first NaN or infinite sample of planes [C, H, W]."""
    for name, plane in zip(names, planes):
        if (bad := ~np.isfinite(plane)).any():
            y, x = np.argwhere(bad)[0]
            count = f"{bad.sum()} NaN or infinite samples in all"
            raise ValueError(f"{path}: channel {name}: {plane[y, x]} at x {x}, y {y} ({count})")


def write_whole(path: Path, file: OpenEXR.File) -> None:
    """Writes an EXR file completely or not at all. Raises OSError."""
    try:
        with replacing(path) as unfinished:
            file.write(str(unfinished))
    except RuntimeError as error:
        raise OSError(f"{path}: cannot write: {' '.join(str(error).split())}") from error


def as_kind(plane: np.ndarray, kind: type[np.floating]) -> np.ndarray:
    """The plane in another float type; too large values become the largest finite one."""
    limit = np.finfo(kind)
    return np.ascontiguousarray(plane.clip(limit.min, limit.max).astype(kind))
