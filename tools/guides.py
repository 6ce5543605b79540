"""Writes a copy of a data set whose albedo and normal are denoised by Intel's Open Image Denoise.

    pip install numpy OpenEXR pyoidn
    python tools/guides.py --data data/own -o data/own-clean
    demc-train --config configs/oidn.toml --set data.root=data/own-clean

Weights that are trained on it expect guides without noise, as Blender has with the prefilter *Accurate*, and
OIDN's own weights `rt_hdr_calb_cnrm` do (docs/oidn.md).

- The channels are found as `demc-infer` finds them, per file (docs/data.md#channel-layouts).
- Albedo of the first hit and normal are denoised, each alone. All other channels and attributes are copied.
- Existing files are kept unless their source is newer.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dataset import add_layout_flags, albedo, manifest, normal, write_manifest
from demc.torch.exr import read_exr
from oidn import prefiltered
from references import stale


def rewrite(source: Path, target: Path, layout: str | None, layer: str | None) -> None:
    frame = read_exr(source, layout, layer)
    planes = {}
    for kind, buffer, feature in (("albedo", "texture1", albedo(frame)), ("normal", "normal", normal(frame))):
        planes |= zip(frame.layout.channels[buffer], prefiltered(kind, feature).transpose(2, 0, 1))
    target.parent.mkdir(parents=True, exist_ok=True)
    frame.file.write(target, planes)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="directory with manifest.json")
    parser.add_argument("-o", "--output", type=Path, required=True, help="directory of the new data set, created if missing")
    parser.add_argument("--split", choices=("train", "test"), help="copy and list this split alone")
    add_layout_flags(parser)
    arguments = parser.parse_args()
    data, output = arguments.data, arguments.output
    try:
        if output.resolve() == data.resolve():
            raise ValueError(f"{output}: expected another directory than --data")
        listed = manifest(data)
        listed["scenes"] = [scene for scene in listed["scenes"] if arguments.split in (None, scene["split"])]
        output.mkdir(parents=True, exist_ok=True)
        for scene in listed["scenes"]:
            source = data / scene["file"]
            scene |= {"file": f"{scene['split']}/{scene['name']}.exr", "guides_denoised": "Open Image Denoise"}
            if stale(output / scene["file"], source):
                rewrite(source, output / scene["file"], arguments.layout, arguments.layer)
        write_manifest(output, listed)
        print(f"{output}: {len(listed['scenes'])} scenes")
    except (OSError, ValueError, KeyError, RuntimeError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
