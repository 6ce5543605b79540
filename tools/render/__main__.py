"""Renders training data with all twelve feature channels, using Mitsuba 3.

    pip install mitsuba numpy OpenEXR
    python tools/render -o data/rooms --rooms 60                     furnished rooms, from a seed
    python tools/render -o data/stills --stills 60                   still lifes, from a seed
    python tools/render -o data/mine kitchen.xml hall.xml            own scenes; a sensor is a view
    python tools/render -o data/rooms --rooms 60 --with data/sample  lists other scenes, too
    python tools/render -o data/rooms --rooms 60 --spp 1,4,16        three noisy images per view
    python tools/render -o data/rooms --rooms 60 --passes paper      what NFOR and KPCN need (docs/data.md#passes)
    python tools/render -o data/rooms --rooms 60 --shard 1/4         a part, on a farm (docs/farms.md)
    python tools/render -o data/bundled --preset train               the training data of the bundled models
    python tools/render -o data/bundled --preset train-kinds         more of it, of kinds that are hard to denoise
    python tools/render -o data/heldout --preset heldout             their test scenes
    python tools/render -o data/heldout-2 --preset heldout-2         their test scenes, second edition
    python tools/render -o data/comparison --preset comparison       the scenes of the paper's comparison

Existing images are kept: rerun a command to resume it. Mitsuba needs LLVM's shared library (Debian:
libllvm19); DRJIT_LIBLLVM_PATH names it if Mitsuba does not find it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import views
from comparison import ComparisonRoom, ComparisonStill, GlassBalls
from kinds import KINDS, kind_of
from reserved import ReservedRoom, ReservedStill
from rooms import Room
from stills import Still
from variant import mi

from demc.torch.shard import add_shard_flag  # `views` puts the packages on the path.
from rendered import COUNTS, HELD_OUT, TEST, add_flags, drawn_counts, files_of, left_out, make_view, run, write_manifest

RENDERER = f"Mitsuba {mi.__version__}"
NOISE = (0.2, 16.0)
"""Range of RelMSE of a room's noisy image. Views outside it are left out."""
STILL_NOISE = (0.03, 16.0)
"""The same for a still life. Its cleaner images teach the network to keep textures."""
NEAR, STILL_NEAR = 0.5, 0.15
"""Smallest distance of a view, in metres, in rooms and still lifes (`Budget.near`)."""

EDITIONS = {
    "train": (Room, Still),
    "heldout": (ReservedRoom, ReservedStill),
    "comparison": (ComparisonRoom, ComparisonStill),
    "glass": (ComparisonRoom, GlassBalls),
}
"""The rooms and still lifes of `--edition`."""
TRAINING = {"rooms": 680, "stills": 380, "size": 192, "spp": COUNTS, "counts": 3, "traits": 0.25, "seed": 29}
COMPARISON = {"edition": "comparison", "passes": "paper"}
PRESETS = {
    "train": [TRAINING],
    "train-kinds": [
        {"kind": kind, "stills": 60, "size": 192, "spp": COUNTS, "counts": 3, "traits": 0.25, "moving": 0.15, "seed": 5029 + 100 * number}
        for number, kind in enumerate(KINDS)
    ],
    "heldout": [HELD_OUT | {"rooms": 78, "stills": 20, "seed": 1029}],
    "heldout-2": [
        HELD_OUT | {"rooms": 60, "stills": 10, "moving": 0.15, "seed": 6029},
        *(HELD_OUT | {"kind": kind, "stills": 6, "seed": 6129 + 100 * number} for number, kind in enumerate(KINDS)),
    ],
    "comparison": [
        COMPARISON | {"rooms": 170, "stills": 80, "size": 192, "seed": 2029},
        COMPARISON | TEST | {"rooms": 110, "stills": 40, "ref_spp": 1024, "seed": 3029},
        COMPARISON | TEST | {"stills": 10, "ref_spp": 1024, "edition": "glass", "seed": 4029},
    ],
}
"""Options of `--preset`, part by part."""


@dataclass
class Base:
    """A scene and its views."""

    name: str
    views: list[str]
    seed: int
    budget: views.Budget
    load: Callable[[], mi.Scene]


def main() -> None:
    for args in arguments():
        render(args)


def render(args: argparse.Namespace) -> None:
    """Renders one part of a preset, or what the options ask for."""
    folder = args.output / args.split
    folder.mkdir(parents=True, exist_ok=True)
    budget = views.Budget(args.ref_spp, args.residual)
    known = left_out(args.output)
    rooms = made(args, "room", args.rooms, furnished_room, 0, replace(budget, noise=NOISE, near=NEAR))
    stills = made(args, "still", args.stills, still_life, 50000, replace(budget, noise=STILL_NOISE, near=STILL_NEAR))
    bases = [*own_scenes(args, budget), *rooms, *stills]
    own = {name for base in bases for name in base.views}
    if args.shard:
        own = args.shard.keep(own)
    for base in bases:
        wanted = {}
        for view, name in enumerate(base.views):
            rng = np.random.default_rng([base.seed, view, 7])
            counts = drawn_counts(args, rng)
            files = files_of(name, counts, args)
            wanted[name] = files, views.Traits.draw(rng, args.traits, args.moving)
        missing = [
            name for name, (files, _) in wanted.items()
            if name in own and name not in known and not all((folder / f"{file}.exr").exists() for file in files.values())
        ]
        scene = base.load() if missing else None
        for name in missing:
            view = base.views.index(name)
            files, traits = wanted[name]
            place = {"base": base.name} | ({"kind": args.kind} if args.kind else {})
            seed, passes = (base.seed + view) * 1000, args.passes is not None
            photograph = partial(views.photograph, scene, view, seed, base.budget, [*files], traits, passes)
            make_view(args, name, place, files.values(), RENDERER, photograph)
    write_manifest(args, RENDERER)


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
    kind, _ = EDITIONS[args.edition]
    room = kind(rng, args.grain, np.random.default_rng([args.seed, index, 2]))
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
    _, kind = EDITIONS[args.edition]
    if args.kind:
        kind = kind_of(KINDS[args.kind], kind)
    still = kind(rng, args.grain, np.random.default_rng([args.seed, index, 5]))
    lamps = np.random.default_rng([args.seed, index, 6])
    if lamps.random() < args.studio:
        still.darken(lamps)
    return still, rng


def arguments() -> list[argparse.Namespace]:
    """The options of each part."""
    whole = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python tools/render", description=__doc__, formatter_class=whole)
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
    parser.add_argument("--traits", type=float, default=0.0, metavar="SHARE", help="share of the views with a Gaussian pixel filter, with albedo behind glass, and with another exposure, each [0]")
    parser.add_argument("--moving", type=float, default=0.0, metavar="SHARE", help="share of the views that a moving camera blurs [0]")
    parser.add_argument("--passes", choices=("paper",), help="also write what the paper's comparison needs: half buffers, variances, depth, diffuse and specular parts")
    parser.add_argument("--edition", choices=[*EDITIONS], default="train", help="furniture, textures, and lights: of training, of the held-out set, of the paper's comparison, or glass balls; no two share any [train]")
    parser.add_argument("--kind", choices=[*KINDS], help="still lifes of a kind that is hard to denoise: glass and mirrors, many lamps, plants in the sun, nets and print, or hair")
    parser.add_argument("--preset", choices=[*PRESETS], help="training data or test scenes of the bundled models, or the scenes of the paper's comparison; other options change it")
    add_flags(parser)
    add_shard_flag(parser, "views")
    parts = []
    for options in PRESETS.get(parser.parse_known_args()[0].preset, [{}]):
        initial = {name: parser.get_default(name) for name in options}
        parser.set_defaults(**options)
        parts.append(parser.parse_args())
        parser.set_defaults(**initial)
    for args in parts:
        check(parser, args)
    return parts


def check(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Ends with an error for options that do not fit."""
    if not args.scenes and args.rooms < 1 and args.stills < 1:
        parser.error("nothing to render: --rooms N, --stills N, or SCENE.xml")
    stems = [path.stem for path in args.scenes]
    if len(set(stems)) < len(stems):
        parser.error("two scene files have the same name")
    if args.passes and (args.traits or any(count % 2 for count in args.spp)):
        parser.error("--passes needs --traits 0 and even numbers of --spp, for two halves")


if __name__ == "__main__":
    run(main)
