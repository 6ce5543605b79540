"""Renders training data with all twelve feature channels, using Mitsuba 3.

    pip install mitsuba numpy OpenEXR
    python python/render -o data/rooms --rooms 60                     furnished rooms, from a seed
    python python/render -o data/stills --stills 60                   still lifes, from a seed
    python python/render -o data/mine kitchen.xml hall.xml            own scenes; a sensor is a view
    python python/render -o data/rooms --rooms 60 --with data/sample  lists other scenes, too

Existing images are kept: rerun a command to resume it. Mitsuba needs LLVM's shared library (Debian:
libllvm19); DRJIT_LIBLLVM_PATH names it if Mitsuba does not find it.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import views
from rooms import Room
from stills import Still
from variant import mi

NOISE = (0.2, 16.0)
"""Range of RelMSE of a room's noisy image. Views outside it are left out."""
STILL_NOISE = (0.03, 16.0)
"""The same for a still life. Its cleaner images teach the network to keep textures."""
NEAR, STILL_NEAR = 0.5, 0.15
"""Smallest distance of a view, in metres, in rooms and still lifes (`Budget.near`)."""


@dataclass
class Base:
    """A scene and its views."""

    name: str
    views: list[str]
    seed: int
    budget: views.Budget
    load: Callable[[], mi.Scene]


def main() -> None:
    args = arguments()
    folder = args.output / args.split
    folder.mkdir(parents=True, exist_ok=True)
    budget = views.Budget(args.spp, args.ref_spp, args.residual)
    manifest = args.output / "manifest.json"
    left_out = json.loads(manifest.read_text()).get("left_out", {}) if manifest.exists() else {}
    rooms = made(args, "room", args.rooms, furnished_room, 0, replace(budget, noise=NOISE, near=NEAR))
    stills = made(args, "still", args.stills, still_life, 50000, replace(budget, noise=STILL_NOISE, near=STILL_NEAR))
    for base in [*own_scenes(args, budget), *rooms, *stills]:
        missing = [name for name in base.views if not (folder / f"{name}.exr").exists() and name not in left_out]
        scene = base.load() if missing else None
        for name in missing:
            start, view = time.monotonic(), base.views.index(name)
            try:
                channels, facts = views.photograph(scene, view, (base.seed + view) * 1000, base.budget)
                entry = {"name": name, "split": args.split, "base": base.name, "file": f"{args.split}/{name}.exr", **facts}
                views.write(folder / f"{name}.exr", channels, entry)
                said = "RelMSE {noisy_relmse:.2f}, reference {ref_residual_relmse:.3f} at {ref_spp} spp".format(**facts)
            except views.Unsuitable as reason:
                left_out[name] = str(reason)
                said = f"left out: {reason}"
            write_manifest(args, left_out)
            print(f"{name}: {said}, {time.monotonic() - start:.0f} s", flush=True)
    write_manifest(args, left_out)


def own_scenes(args, budget: views.Budget) -> Iterator[Base]:
    """Scenes from files; each sensor is a view."""
    for path in args.scenes:
        scene = mi.load_file(str(path))
        names = [f"{path.stem}-{view}" for view in range(len(scene.sensors()))]
        yield Base(path.stem, names, args.seed * 100003, budget, lambda scene=scene: scene)


def made(args, kind: str, count: int, make: Callable, first_seed: int, budget: views.Budget) -> Iterator[Base]:
    """Rooms or still lifes. Each depends on its number and the seed only, not on `count`."""
    for index in range(count):

        def load(index: int = index) -> mi.Scene:
            subject, rng = make(args, index)
            for view in range(args.views):
                subject.scene[f"camera{view}"] = subject.camera(rng, args.size)
            return mi.load_dict(subject.scene)

        name = f"{kind}-{args.seed}-{index}"
        names = [f"{name}-{view}" for view in range(args.views)]
        yield Base(name, names, args.seed * 100003 + first_seed + index * 16, budget, load)


def furnished_room(args, index: int) -> tuple[Room, np.random.Generator]:
    """A room, and the random generator for its cameras."""
    rng = np.random.default_rng([args.seed, index])
    # Separate generators: the room stays the same without grain, sun, or black.
    room = Room(rng, args.grain, np.random.default_rng([args.seed, index, 2]))
    outside = np.random.default_rng([args.seed, index, 1])
    if outside.random() < args.sun:
        room.sun(outside)
    paint = np.random.default_rng([args.seed, index, 3])
    if paint.random() < args.black:
        room.blacken(paint)
    return room, rng


def still_life(args, index: int) -> tuple[Still, np.random.Generator]:
    """A still life, and the random generator for its cameras."""
    rng = np.random.default_rng([args.seed, index, 4])
    still = Still(rng, args.grain, np.random.default_rng([args.seed, index, 5]))
    lamps = np.random.default_rng([args.seed, index, 6])
    if lamps.random() < args.studio:
        still.darken(lamps)
    return still, rng


def write_manifest(args, left_out: dict[str, str]) -> None:
    """Lists all rendered scenes and those of `--with`."""
    scenes = [views.entry_of(path) for path in sorted(args.output.glob("*/*.exr"))]
    for other in args.beside:
        for entry in json.loads((other / "manifest.json").read_text())["scenes"]:
            file = os.path.relpath((other / entry["file"]).resolve(), args.output.resolve())
            scenes.append(entry | {"file": file})
    manifest = {"format": "demc-exr 1", "renderer": f"Mitsuba {mi.__version__}", "scenes": scenes, "left_out": left_out}
    unfinished = args.output / ".manifest.json.unfinished"
    unfinished.write_text(json.dumps(manifest, indent=1))
    os.replace(unfinished, args.output / "manifest.json")


def arguments() -> argparse.Namespace:
    whole = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python python/render", description=__doc__, formatter_class=whole)
    parser.add_argument("scenes", nargs="*", type=Path, metavar="SCENE.xml", help="Mitsuba scenes to render")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="DIR", help="data set; other images in it are kept")
    parser.add_argument("--rooms", type=int, default=0, metavar="N", help="number of rooms [0]")
    parser.add_argument("--stills", type=int, default=0, metavar="N", help="number of still lifes [0]")
    parser.add_argument("--views", type=int, default=2, metavar="N", help="views per room or still life [2]")
    parser.add_argument("--size", type=int, default=224, metavar="PIXELS", help="height and width of rooms and still lifes [224]")
    parser.add_argument("--sun", type=float, default=0.6, metavar="SHARE", help="share of the rooms with windows that the sun shines into [0.6]")
    parser.add_argument("--grain", type=float, default=0.6, metavar="SHARE", help="share of colours and patterns that are boards, stone, or cloth [0.6]")
    parser.add_argument("--black", type=float, default=0.2, metavar="SHARE", help="share of the rooms with black bars and blinds [0.2]")
    parser.add_argument("--studio", type=float, default=0.15, metavar="SHARE", help="share of the still lifes in a black studio [0.15]")
    parser.add_argument("--spp", type=int, default=4, metavar="N", help="samples per pixel of the noisy image [4]")
    parser.add_argument("--ref-spp", type=int, default=128, metavar="N", help="largest number of samples per pixel of the reference [128]")
    parser.add_argument("--residual", type=float, default=0.03, metavar="X", help="expected RelMSE at which a reference is good enough [0.03]")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of rooms, still lifes, and samples [1]")
    parser.add_argument("--split", choices=("train", "test"), default="train", help="split of the rendered views [train]")
    parser.add_argument("--with", dest="beside", action="append", default=[], type=Path, metavar="DIR", help="data set whose scenes are also listed; can be repeated")
    args = parser.parse_args()
    if not args.scenes and args.rooms < 1 and args.stills < 1:
        parser.error("nothing to render: --rooms N, --stills N, or SCENE.xml")
    stems = [path.stem for path in args.scenes]
    if len(set(stems)) < len(stems):
        parser.error("two scene files have the same name")
    return args


if __name__ == "__main__":
    main()
