"""Makes a data set for an albedo filter from data sets that have `ref.albedo1.*`.

    python configs/bundled/albedo_set.py DATA... -o OUT

Colour becomes the noisy first albedo, the reference that of many samples, both between 0 and 1. Views without
`ref.albedo1.*`, copies, and the test split are left out. Needs numpy and OpenEXR.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import OpenEXR


def albedo_view(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The channels of a view in the layout `demc-exr`."""
    clamped = {name: np.nan_to_num(plane.astype(np.float32)).clip(0, 1).astype(np.float16) for name, plane in channels.items() if "albedo1" in name}
    out = {name: plane for name, plane in channels.items() if not name.startswith("ref.")}
    for letter in "RGB":
        noisy = clamped[f"albedo1.{letter}"]
        out |= {letter: noisy, f"albedo1.{letter}": noisy, f"albedo2.{letter}": noisy}
        out[f"ref.{letter}"] = clamped[f"ref.albedo1.{letter}"]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    (options.output / "train").mkdir(parents=True, exist_ok=True)
    scenes: dict[str, dict] = {}
    for data in options.data:
        for scene in json.loads((data / "manifest.json").read_text())["scenes"]:
            name = scene["name"]
            if scene["split"] != "train" or "-copy-" in name or name in scenes:
                continue
            with OpenEXR.File(str(data / scene["file"]), separate_channels=True) as file:
                channels = {name: channel.pixels for name, channel in file.channels().items()}
            if "ref.albedo1.R" not in channels:
                continue
            path = Path("train") / f"{name}.exr"
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, albedo_view(channels)).write(str(options.output / path))
            scenes[name] = scene | {"file": str(path)}
    if not scenes:
        parser.error("no view has the channels ref.albedo1.*")
    manifest = {"format": "demc-exr 1", "scenes": list(scenes.values())}
    (options.output / "manifest.json").write_text(json.dumps(manifest, indent=1))
    print(f"{len(scenes)} views")


if __name__ == "__main__":
    main()
