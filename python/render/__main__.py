"""Renders training data with all twelve feature channels, by Mitsuba 3.

    pip install mitsuba numpy OpenEXR
    python python/render -o data/rooms --rooms 60                       furnished rooms out of nothing but a seed
    python python/render -o data/stills --stills 60                     things on tables and squares, seen through a lens
    python python/render -o data/mine kitchen.xml hall.xml              your own Mitsuba scenes, each sensor a view
    python python/render -o data/rooms --rooms 60 --with data/sample    with another data set's scenes in the manifest

What is there already is kept: a second call goes on where the first was stopped. Mitsuba compiles with LLVM and finds
its shared library (Debian: libllvm19) by itself or by DRJIT_LIBLLVM_PATH.
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
"""RelMSE of a room's noisy image: cleaner teaches nothing, and what is worse at 4 samples nobody renders."""
STILL_NOISE = (0.03, 16.0)
"""Of a still life's, whose clean images teach to keep a texture."""
NEAR, STILL_NEAR = 0.5, 0.15
"""Metres, in a room and before a still life."""


@dataclass
class Base:
    """A scene, and the views of it."""

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
                said = "RelMSE {noisy_relmse:.2f}, reference's {ref_residual_relmse:.3f} at {ref_spp} samples".format(**facts)
            except views.Unsuitable as reason:
                left_out[name] = str(reason)
                said = f"left out, {reason}"
            write_manifest(args, left_out)
            print(f"{name}: {said}, {time.monotonic() - start:.0f} s", flush=True)
    write_manifest(args, left_out)


def own_scenes(args, budget: views.Budget) -> Iterator[Base]:
    """Scenes from files: each sensor is a view."""
    for path in args.scenes:
        scene = mi.load_file(str(path))
        names = [f"{path.stem}-{view}" for view in range(len(scene.sensors()))]
        yield Base(path.stem, names, args.seed * 100003, budget, lambda scene=scene: scene)


def made(args, kind: str, count: int, make: Callable, first_seed: int, budget: views.Budget) -> Iterator[Base]:
    """Rooms or still lifes by number: the same for the same seed, however many are asked for."""
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
    """A room, and the numbers that go on to its cameras."""
    rng = np.random.default_rng([args.seed, index])
    # Numbers of their own: the room is the same without grains, a sun or black.
    room = Room(rng, args.grain, np.random.default_rng([args.seed, index, 2]))
    outside = np.random.default_rng([args.seed, index, 1])
    if outside.random() < args.sun:
        room.sun(outside)
    paint = np.random.default_rng([args.seed, index, 3])
    if paint.random() < args.black:
        room.blacken(paint)
    return room, rng


def still_life(args, index: int) -> tuple[Still, np.random.Generator]:
    """A still life, and the numbers that go on to its cameras."""
    rng = np.random.default_rng([args.seed, index, 4])
    still = Still(rng, args.grain, np.random.default_rng([args.seed, index, 5]))
    lamps = np.random.default_rng([args.seed, index, 6])
    if lamps.random() < args.studio:
        still.darken(lamps)
    return still, rng


def write_manifest(args, left_out: dict[str, str]) -> None:
    """Lists every scene that is there, and those of `--with`."""
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
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="DIR", help="the data set; other images in it are kept")
    parser.add_argument("--rooms", type=int, default=0, metavar="N", help="rooms to render; each is its number and the seed")
    parser.add_argument("--stills", type=int, default=0, metavar="N", help="still lifes to render; each is its number and the seed")
    parser.add_argument("--views", type=int, default=2, metavar="N", help="of each room or still life [2]")
    parser.add_argument("--size", type=int, default=224, metavar="PIXELS", help="both sides of their views [224]")
    parser.add_argument("--sun", type=float, default=0.6, metavar="SHARE", help="of the rooms with windows that the sun shines into [0.6]")
    parser.add_argument("--grain", type=float, default=0.6, metavar="SHARE", help="of the colours and patterns that are boards, stone or cloth [0.6]")
    parser.add_argument("--black", type=float, default=0.2, metavar="SHARE", help="of the rooms whose bars and blinds are black [0.2]")
    parser.add_argument("--studio", type=float, default=0.15, metavar="SHARE", help="of the still lifes that stand in a black studio [0.15]")
    parser.add_argument("--spp", type=int, default=4, metavar="N", help="samples a pixel of the noisy image [4]")
    parser.add_argument("--ref-spp", type=int, default=128, metavar="N", help="of the reference, at most [128]")
    parser.add_argument("--residual", type=float, default=0.03, metavar="X", help="expected RelMSE of a reference that is good enough [0.03]")
    parser.add_argument("--seed", type=int, default=1, help="[1]")
    parser.add_argument("--split", choices=("train", "test"), default="train", help="[train]")
    parser.add_argument("--with", dest="beside", action="append", default=[], type=Path, metavar="DIR", help="data set whose scenes are listed too")
    args = parser.parse_args()
    if not args.scenes and args.rooms < 1 and args.stills < 1:
        parser.error("nothing to render: --rooms N, --stills N, or SCENE.xml")
    stems = [path.stem for path in args.scenes]
    if len(set(stems)) < len(stems):
        parser.error("two scenes have one name")
    return args


if __name__ == "__main__":
    main()
