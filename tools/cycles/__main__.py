"""Renders training data with Blender Cycles: volumes, hair, motion, procedural materials.

    pip install bpy numpy OpenEXR
    python tools/cycles -o data/cycles --scenes 60                   scenes of all kinds, from a seed
    python tools/cycles -o data/smoke --scenes 20 --kind volume      of one kind
    python tools/cycles -o data/cycles --scenes 60 --with data/rooms lists other scenes, too
    python tools/cycles -o data/cycles --scenes 60 --shard 1/4       a part, on a farm (docs/farms.md)
    python tools/cycles -o data/blender --preset train --with data/bundled
                                                                     training data of the bundled models
    python tools/cycles -o data/heldout-cycles --preset heldout-2 --with data/heldout-2
                                                                     their test scenes, second edition

Features are those that Cycles writes; the second albedo is a copy of the first. The same seed gives the same views but for
rounding. Existing images are kept: rerun a command to resume it.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))

import rendered
import scenes
import shot

from demc.torch.shard import add_shard_flag  # `rendered` puts the package on the path.

RENDERER = f"Cycles {scenes.bpy.app.version_string}"
SHARES = {"things": 0.25, "volume": 0.35, "fur": 0.25, "motion": 0.15}
"""How many scenes are of each kind."""
NOISE = (0.003, 16.0)
"""Range of RelMSE of an image with 4 samples per pixel. Views outside it are left out."""
PRESETS = {
    "train": {"scenes": 160, "size": 192, "spp": rendered.COUNTS, "counts": 3, "relit": 0.7, "seed": 5929},
    "heldout-2": rendered.HELD_OUT | {"scenes": 36, "seed": 6929},
}
"""Options of `--preset`."""


def main() -> None:
    args = arguments()
    folder = args.output / args.split
    folder.mkdir(parents=True, exist_ok=True)
    known = rendered.left_out(args.output)
    kinds = [args.kind] * args.scenes if args.kind else in_turn(args.scenes)
    names = {f"cycles-{args.seed}-{index}-{view}": (index, view) for index in range(args.scenes) for view in range(args.views)}
    own = args.shard.keep(set(names)) if args.shard else set(names)
    for name, (index, view) in names.items():
        rng = np.random.default_rng([args.seed, index, view, 1])
        counts = rendered.drawn_counts(args, rng)
        files = rendered.files_of(name, counts, args)
        if name not in own or name in known or all((folder / f"{file}.exr").exists() for file in files.values()):
            continue
        place = {"base": f"cycles-{args.seed}-{index}", "kind": kinds[index]}
        settings = shot.Settings.draw(rng, args.adaptive)
        photograph = partial(photograph_view, args, index, view, kinds[index], counts, settings, rng)
        rendered.make_view(args, name, place, files.values(), RENDERER, photograph)
    rendered.write_manifest(args, RENDERER)


def photograph_view(
    args: argparse.Namespace, index: int, view: int, kind: str, counts: list[int], settings: shot.Settings, rng: np.random.Generator
) -> list[tuple[dict, dict]]:
    """Builds a scene and renders one view of it."""
    stage = scenes.build(args.seed, index, kind, args.edition)
    stage.camera(np.random.default_rng([args.seed, index, view, 3]))
    shot.prepare(stage.scene, args.size, settings)
    stage.group(rng)
    mixes = shot.draw_mixes(rng, len(counts), args.relit)
    seed = (args.seed * 100003 + index * 16 + view) * 1000
    return shot.photograph(stage.scene, seed, counts, settings, mixes, args.ref_spp, args.residual, NOISE)


def in_turn(count: int) -> list[str]:
    """The kind of each scene: always the one that is furthest behind its share."""
    found: list[str] = []
    for number in range(1, count + 1):
        found.append(max(SHARES, key=lambda kind: SHARES[kind] * number - found.count(kind)))
    return found


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python tools/cycles", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="DIR", help="data set; other images in it are kept")
    parser.add_argument("--scenes", type=int, default=0, metavar="N", help="number of scenes")
    parser.add_argument("--views", type=int, default=2, metavar="N", help="views per scene [2]")
    parser.add_argument("--size", type=int, default=224, metavar="PIXELS", help="height and width [224]")
    parser.add_argument("--kind", choices=[*scenes.KINDS], help="things alone, in fog, smoke, or clouds, with hair, or moving [all in turn]")
    parser.add_argument("--adaptive", type=float, default=0.3, metavar="SHARE", help="share of the views with adaptive sampling [0.3]")
    parser.add_argument("--relit", type=float, default=0.0, metavar="SHARE", help="share of the views whose images each have other light: sky and groups of lamps are rendered apart and mixed anew [0]")
    parser.add_argument("--edition", choices=[*scenes.EDITIONS], default="train", help="shapes, textures, and lights of training or of the held-out set; they share none [train]")
    rendered.add_flags(parser)
    parser.add_argument("--preset", choices=[*PRESETS], help="training data or test scenes of the bundled models; other options change it")
    add_shard_flag(parser, "views")
    parser.set_defaults(**PRESETS.get(parser.parse_known_args()[0].preset, {}))
    args = parser.parse_args()
    if args.scenes < 1:
        parser.error("nothing to render: --scenes N")
    return args


if __name__ == "__main__":
    rendered.run(main)
