"""Fine-tunes an export of `demc-infer export --names torch` on a data set, in PyTorch.

pip install './bindings/python[torch]' (in the repository root). `demc-infer import OUTPUT -o FILE` loads the result.
"""

import argparse
import json
import sys
from pathlib import Path

import demc.torch
import torch
from safetensors.torch import save_file
from torch.utils.data import DataLoader, Dataset

CROP = 128  # Height and width of the crops, in pixels; a multiple of 32.


class Crops(Dataset):
    """One random crop of each training scene: colour, features, and reference."""

    def __init__(self, root: Path, bundle: demc.torch.Bundle, layout: str | None) -> None:
        scenes = json.loads((root / "manifest.json").read_text())["scenes"]
        self.paths = [root / scene["file"] for scene in scenes if scene["split"] == "train"]
        self.meta, self.layout = bundle.meta, layout

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, ...]:
        frame = demc.torch.read_exr(self.paths[index], self.layout, bundle=self.meta)
        if frame.reference is None or min(frame.color.shape[1:]) < CROP:
            raise ValueError(f"{self.paths[index]}: expected a reference and {CROP}x{CROP} pixels")
        # Exposure and positions need the whole image.
        color, features, scale = demc.torch.preprocess.prepare(frame.color, frame.features, self.meta)
        top, left = (int(torch.randint(size - CROP + 1, ())) for size in color.shape[1:])
        crop = lambda image: torch.from_numpy(image[:, top : top + CROP, left : left + CROP].copy())
        return crop(color), crop(features), crop(frame.reference * scale)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help="file of demc-infer export --names torch")
    parser.add_argument("output", help="safetensors file for the weights")
    parser.add_argument("--data", type=Path, required=True, help="directory with manifest.json")
    parser.add_argument("--layout", help="preset or TOML file of the channels; default: the one that fits")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--lr", type=float, default=1e-5)
    arguments = parser.parse_args()

    device = "cuda" if torch.cuda.is_available() else "cpu"
    bundle = demc.torch.load(arguments.model).to(device)
    crops = DataLoader(Crops(arguments.data, bundle, arguments.layout), arguments.batch, shuffle=True)
    optimizer = torch.optim.Adam(bundle.model.parameters(), arguments.lr)
    bundle.model.train()
    step = 0
    while step < arguments.steps:
        for color, features, reference in crops:
            output = bundle.radiance(color.to(device), features.to(device))
            loss = demc.torch.rel_mse(output, reference.to(device))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            step += 1
            print(f"step {step}: RelMSE {loss.item():.4f}")
            if step == arguments.steps:
                break

    meta = bundle.meta | {"step": bundle.step + step}
    save_file(bundle.tensors(), arguments.output, {"demc": json.dumps(meta)})


if __name__ == "__main__":
    try:
        main()
    except (OSError, ValueError, KeyError) as error:
        sys.exit(f"error: {error}")
