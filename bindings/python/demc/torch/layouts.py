"""Layouts: which channels of a renderer's file hold colour, features, and reference. No PyTorch.

The rules are those of `demc-infer`. The presets are the files of `configs/renderers`. Passes of the paper's
comparison are not read here.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

PRESETS = ("demc-exr", "mitsuba3", "pbrt-v4", "cycles", "luxcore", "fbksd")
"""The layouts that come with the package."""
BUFFERS = ("normal", "position", "texture1", "texture2")
"""The feature buffers, in the network's order."""
MISSING = {"normal": "error", "position": "zeros", "texture1": "error", "texture2": "copy-texture1"}
"""Policies for buffers that a file lacks, unless the model's training layout has its own."""
ANY_LAYER = "*."
"""The start of a name that stands for any view layer, the same one in all names of a layout."""
SHOWN = 20
"""Number of channels that a message shows."""


@dataclass(frozen=True)
class Layout:
    """The channel names of a renderer's files."""

    name: str  # for messages
    channels: Mapping[str, tuple[str, ...]]  # of color, BUFFERS, reference, mask, alpha; without absent ones
    alternatives: Mapping[str, tuple[tuple[str, ...], ...]]  # other names of BUFFERS, for files without these
    missing: Mapping[str, str]  # of each of BUFFERS: error, zeros, or copy-texture1
    layer: str | None = None  # the view layer in place of `*`

    @classmethod
    def from_table(cls, name: str, table: Mapping) -> Layout:
        """A layout from parsed TOML or JSON. Raises ValueError with all its mistakes."""
        known = ("color", *BUFFERS, "reference", "mask", "alpha", "passes", "alternatives", "missing")
        problems = [f"unknown key {key}" for key in table if key not in known]
        channels, given = {}, table.get("missing", {})
        for buffer in ("color", *BUFFERS, "reference"):
            names = table.get(buffer)
            if is_triple(names):
                channels[buffer] = tuple(names)
            elif names is not None or buffer == "color":
                problems.append(f"{buffer}: expected three names of channels")
        for key in ("mask", "alpha"):
            if isinstance(name_of_one := table.get(key), str):
                channels[key] = (name_of_one,)
            elif name_of_one is not None:
                problems.append(f"{key}: expected the name of a channel")
        alternatives, others = {}, table.get("alternatives", {})
        if not isinstance(others, Mapping):
            problems.append("alternatives: expected a table")
            others = {}
        for buffer, triples in others.items():
            if buffer not in BUFFERS:
                problems.append(f"unknown key alternatives.{buffer}")
            elif not isinstance(triples, list) or not all(map(is_triple, triples)):
                problems.append(f"alternatives.{buffer}: expected lists of three names of channels")
            elif triples and buffer not in table:
                problems.append(f"alternatives.{buffer} needs {buffer}, the names that come first")
            else:
                alternatives[buffer] = tuple(map(tuple, triples))
        if not isinstance(table.get("passes", {}), Mapping):
            problems.append("passes: expected a table")
        if not isinstance(given, Mapping):
            problems.append("missing: expected a table")
            given = {}
        missing = dict.fromkeys(BUFFERS, "error") | given
        for buffer, policy in missing.items():
            if buffer not in BUFFERS:
                problems.append(f"unknown key missing.{buffer}")
            elif policy == "copy-texture1" and buffer != "texture2":
                problems.append(f'missing.{buffer} cannot be "copy-texture1": only texture2 can')
            elif policy not in ("error", "zeros", "copy-texture1"):
                problems.append(f'missing.{buffer}: expected "error", "zeros", or "copy-texture1"')
            elif policy == "error" and buffer not in table:
                problems.append(f"{buffer} names no channels: name them or set missing.{buffer}")
        triples = [*channels.values(), *(names for others in alternatives.values() for names in others)]
        names = [channel for triple in triples for channel in triple]
        twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
        problems += [f"channel {json.dumps(name)} is named twice" for name in twice]
        if problems:
            raise ValueError(f"channel layout {name}: {'; '.join(problems)}")
        return cls(name, channels, alternatives, missing)

    def allowing(self, missing: Mapping[str, str]) -> Layout:
        """This layout with the policies of `missing` for buffers whose absence is an error."""
        return replace(self, missing=either(self.missing, missing))

    def layers(self, found: Collection[str]) -> list[str]:
        """The view layers whose colour is among the channels `found`, in their order."""
        if not self.has_any_layer():
            return []
        ends = [name.removeprefix("*") for name in self.channels["color"]]
        layers = (name.removesuffix(ends[0]) for name in found if name.endswith(ends[0]))
        return [layer for layer in layers if all(layer + end in found for end in ends)]

    def has_any_layer(self) -> bool:
        """Whether `*` stands for a view layer."""
        return self.channels["color"][0].startswith(ANY_LAYER)

    def with_layer(self, layer: str) -> Layout:
        """The names with the view layer in place of `*`."""
        named = lambda name: f"{layer}.{name.removeprefix(ANY_LAYER)}" if name.startswith(ANY_LAYER) else name
        channels = {buffer: tuple(map(named, names)) for buffer, names in self.channels.items()}
        others = {buffer: tuple(tuple(map(named, names)) for names in triples) for buffer, triples in self.alternatives.items()}
        return replace(self, channels=channels, alternatives=others, layer=layer)

    def named_as_in(self, found: Collection[str]) -> Layout:
        """This layout with alternatives in place of names that are not among the channels `found`."""
        is_in_file = lambda names: any(name in found for name in names)
        channels = dict(self.channels)
        for buffer, triples in self.alternatives.items():
            if not is_in_file(channels[buffer]):
                channels[buffer] = next(filter(is_in_file, triples), channels[buffer])
        return replace(self, channels=channels, alternatives={})

    def in_file(self, path: Path, found: Collection[str], layer: str | None = None) -> Layout:
        """This layout with the names of one file. `layer` chooses among several view layers."""
        if not self.has_any_layer():
            if layer is not None:
                raise problem(path, f"view layer {json.dumps(layer)}: the names of the layout have no `*` for it")
            return self.named_as_in(found)
        layers = self.layers(found)
        if layer in layers:
            return self.with_layer(layer).named_as_in(found)
        if not layers:
            require(path, self.channels["color"], found)  # Raises: a name with `*` is in no file.
        if layer is not None:
            raise no_layer(path, layer, layers)
        if len(layers) > 1:
            raise problem(path, f"view layers {', '.join(layers)}: choose one")
        return self.with_layer(layers[0]).named_as_in(found)

    def lacking(self, found: Collection[str]) -> list[str]:
        """The channels that a file with the channels `found` must have but lacks."""
        lacking = []
        for buffer in ("color", *BUFFERS):
            names = self.channels.get(buffer, ())
            absent = [name for name in names if name not in found]
            # One channel of three is a mistake, not a missing buffer.
            if self.missing.get(buffer, "error") == "error" or len(absent) < len(names):
                lacking += absent
        return lacking

    def present(self, found: Collection[str]) -> Layout:
        """This layout without the buffers that the file lacks."""
        there = {buffer: names for buffer, names in self.channels.items() if any(name in found for name in names)}
        return replace(self, channels={"color": self.channels["color"]} | there)

    def describe(self) -> str:
        """A description: name, view layer, and what replaces missing buffers."""
        text = f"layout {self.name}" + (f", view layer {json.dumps(self.layer)}" if self.layer else "")
        for buffer in BUFFERS:
            if buffer not in self.channels:
                by = "texture1 replaces it" if self.missing[buffer] == "copy-texture1" else "zeros replace it"
                text += f"; no {buffer}: {by}"
        return text


def is_triple(names: object) -> bool:
    """Whether these are three names of channels."""
    return isinstance(names, list) and len(names) == 3 and all(isinstance(name, str) for name in names)


def resolve(name: str) -> Layout:
    """The preset with this name, or the layout in the TOML file at this path."""
    if name in PRESETS:
        return preset(name)
    if not Path(name).is_file():
        raise ValueError(f"channel layout {name}: neither a preset ({', '.join(PRESETS)}) nor a file")
    return parse(name, Path(name).read_bytes())


@cache
def preset(name: str) -> Layout:
    """One of PRESETS."""
    checkout = Path(__file__).resolve().parents[4] / "configs" / "renderers" / f"{name}.toml"
    if checkout.is_file():
        return parse(name, checkout.read_bytes())
    # In an installed package, the native module has their texts.
    from .._native import presets

    return parse(name, dict(presets())[name].encode())


def parse(name: str, text: bytes) -> Layout:
    """A layout from the text of its file."""
    try:
        table = tomllib.loads(text.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"channel layout {name}: {error}") from error
    return Layout.from_table(name, table)


def either(first: Mapping[str, str], second: Mapping[str, str]) -> dict[str, str]:
    """The policies `first`, and those of `second` for buffers whose absence is an error there."""
    return {buffer: second[buffer] if first[buffer] == "error" else first[buffer] for buffer in BUFFERS}


def detect(path: Path, found: Collection[str], missing: Mapping[str, str], layer: str | None = None) -> Layout:
    """The preset that fits a file with the channels `found`, without the buffers that it lacks.

    It may lack the buffers with a policy in `missing` or in the preset. Raises ValueError if no
    preset fits, if several fit equally well, or if the view layer does not exist.
    """
    fits: list[Layout] = []
    nearest, nearest_found = None, -1
    for pattern in map(preset, PRESETS):
        layers = pattern.layers(found)
        if layer is not None:
            if not pattern.has_any_layer():
                continue
            if layers and layer not in layers:
                raise no_layer(path, layer, layers)
            layers = [layer]
        for candidate in [pattern.with_layer(name) for name in layers] or [pattern]:
            candidate = candidate.named_as_in(found).allowing(missing)
            lacking = candidate.lacking(found)
            names = [name for buffer in ("color", *BUFFERS) for name in candidate.channels.get(buffer, ())]
            count = sum(name in found for name in names)
            if not lacking:
                fits.append(candidate.present(found))
            elif count > nearest_found:
                nearest, nearest_found = (candidate.name, lacking), count
    buffers = lambda layout: sum(buffer in layout.channels for buffer in BUFFERS)
    most = max(map(buffers, fits), default=0)
    best: list[Layout] = []
    for fit in fits:
        if buffers(fit) == most and all(fit.channels != other.channels for other in best):
            best.append(fit)
    if len(best) == 1:
        return best[0]
    if best:
        names = [fit.name + (f" with view layer {json.dumps(fit.layer)}" if fit.layer else "") for fit in best]
        raise problem(path, f"several presets fit equally well: {', '.join(names)}; choose one")
    if nearest is None or nearest_found == 0:
        raise problem(path, f"no preset has any of its channels: {', '.join(list(found)[:SHOWN])}")
    raise problem(path, f"no preset fits; the nearest, {nearest[0]}, lacks {', '.join(nearest[1])}")


def choose(
    path: Path,
    found: Collection[str],
    layout: str | None,
    layer: str | None,
    missing: Mapping[str, str],
    own: Mapping | None,
) -> Layout:
    """The layout of a file: `layout`, otherwise the model's `own` if it fits, otherwise detected."""
    if layout is not None:
        return resolve(layout).in_file(path, found, layer).allowing(missing)
    if own is not None:
        try:
            fitting = Layout.from_table("of the model", own).in_file(path, found, layer)
        except ValueError:
            fitting = None
        if fitting is not None and not fitting.lacking(found):
            return fitting
    return detect(path, found, missing, layer)


def require(path: Path, names: Iterable[str], found: Collection[str]) -> None:
    """Raises ValueError for names that are not among the channels `found` of a file."""
    if missing := [name for name in dict.fromkeys(names) if name not in found]:
        raise ValueError(f"{path}: no channel {', '.join(missing)}; the file has {', '.join(found)}")


def printable(name: str) -> str:
    """A name that is safe to print in a one-line message."""
    return re.sub(r"[\x00-\x1f\x7f-\x9f]", "\ufffd", name)


def problem(path: Path, detail: str) -> ValueError:
    return ValueError(f"channel layout of {path}: {detail}")


def no_layer(path: Path, layer: str, layers: list[str]) -> ValueError:
    return problem(path, f"no view layer {json.dumps(layer)}; there is {', '.join(layers)}")
