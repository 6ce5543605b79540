"""Makes a U-Net with fewer channels from a trained one, as a start for training.

    python configs/bundled/prune.py LARGE.safetensors --size medium --data DATA -o START.safetensors

Layer by layer, from the input to the output: the channels whose output counts most in the next layers stay.
Least squares on crops of training views fit the new layer to the large network's maps of these channels. It
sees the new network's own maps, so each layer also corrects what the layers before it lost. 64 crops take
about 3 minutes on 2 cores. An albedo filter stays. Needs numpy, OpenEXR, torch, and safetensors.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional as F

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))

from dataset import scenes

from demc.torch import load  # `dataset` puts the package on the path.
from demc.torch import preprocess
from demc.torch.bundle import Bundle
from demc.torch.exr import read_exr
from demc.torch.unet import SIZES, Unet

CROPS, SIDE = 64, 160
PIXELS = 40_000
"""Pixels that a layer is fitted to."""
DAMPING = 1e-4
"""Relative to the mean square of an input."""


@dataclass
class Maps:
    """What a layer reads: the maps [N, C, H, W] of the large network and of the new one."""

    large: Tensor
    new: Tensor

    def each(self, change) -> Maps:
        return Maps(change(self.large), change(self.new))

    def beside(self, skip: Maps) -> Maps:
        return Maps(torch.cat((self.large, skip.large), 1), torch.cat((self.new, skip.new), 1))


def crops(bundle: Bundle, data: Path) -> Tensor:
    """The network's input in crops of training views, [N, C, SIDE, SIDE]."""
    rng = np.random.default_rng(0)
    paths = scenes(data, "train")
    chosen = rng.choice(len(paths), min(CROPS, len(paths)), replace=False)
    found: list[Tensor] = []
    catch = bundle.model.register_forward_pre_hook(lambda _, inputs: found.append(whole(bundle.model, *inputs)))
    for index in chosen:
        frame = read_exr(paths[index], None, None)
        color, features, _ = preprocess.prepare(frame.color, frame.features, bundle.meta)
        bundle.radiance(torch.as_tensor(color)[None].float(), torch.as_tensor(features)[None].float())
        height, width = found[-1].shape[-2:]
        if min(height, width) < SIDE:
            raise ValueError(f"{paths[index]}: smaller than {SIDE}x{SIDE}")
        top, left = rng.integers(0, height - SIDE + 1), rng.integers(0, width - SIDE + 1)
        found[-1] = found[-1][:, :, top : top + SIDE, left : left + SIDE]
    catch.remove()
    return torch.cat(found)


def whole(network: Unet, color: Tensor, features: Tensor) -> Tensor:
    """Colour and guides as the first layer sees them."""
    return torch.cat((color, *(features[:, first : first + 3] for first in network.guides)), 1)


def one_by_one(change, maps: Tensor) -> Tensor:
    return torch.cat([change(image[None]) for image in maps])


def fit(old: nn.Conv2d, new: nn.Conv2d, maps: Maps, kept: Tensor) -> float:
    """Sets the new convolution so that its output is that of the old one's kept channels; returns the error."""
    rng = torch.Generator().manual_seed(1)
    inputs, outputs = [], []
    for large, small in zip(maps.large, maps.new):
        chosen = torch.randperm(large[0].numel(), generator=rng)[: max(1, PIXELS // len(maps.large))]
        inputs.append(F.unfold(small[None], 3, padding=1)[0][:, chosen].T)
        outputs.append(old(large[None])[0, kept].flatten(1)[:, chosen].T)
    ones = torch.ones(sum(map(len, inputs)), 1)
    a, b = torch.cat((torch.cat(inputs), ones), 1).double(), torch.cat(outputs).double()
    gram = a.T @ a
    gram += torch.eye(len(gram)).double() * DAMPING * gram.diagonal().mean()
    solution = torch.linalg.solve(gram, a.T @ b)
    new.weight.copy_(solution[:-1].T.reshape(new.weight.shape))
    new.bias.copy_(solution[-1])
    return float(((a @ solution - b) ** 2).mean() / b.var(0).mean())


def readers(network: Unet) -> Iterator[list[Tensor]]:
    """For each convolution before the head, the weights [O, C, 3, 3] that read its channels."""
    encoder, decoder = network.encoder, network.decoder
    levels = [*encoder, network.bottom, *decoder]
    for index, level in enumerate(levels):
        for conv, following in zip(level.convs, level.convs[1:]):
            yield [following.weight]
        channels = level.convs[-1].out_channels
        after = levels[index + 1].convs[0] if index + 1 < len(levels) else network.head
        found = [after.weight[:, :channels]]
        # The maps of all encoder levels but the deepest are skips of the decoder, too.
        if index + 1 < len(encoder):
            found.append(decoder[len(encoder) - 2 - index].convs[0].weight[:, -channels:])
        yield found


def prune(network: Unet, new: Unet, images: Tensor) -> None:
    """Sets the weights of `new`, a network with fewer channels."""
    maps = Maps(images, images)
    skips: list[Maps] = []
    counts = readers(network)

    def level(old_level: nn.Module, new_level: nn.Module, maps: Maps, name: str) -> Maps:
        for number, (old, fresh) in enumerate(zip(old_level.convs, new_level.convs)):
            size = one_by_one(lambda x: F.relu(old(x)), maps.large).double().square().mean((0, 2, 3)).sqrt()
            weight = sum(w.double().square().sum((0, 2, 3)) for w in next(counts)).sqrt()
            kept = (size * weight).topk(fresh.out_channels).indices.sort().values
            error = fit(old, fresh, maps, kept)
            print(f"{name}.{number}: {fresh.out_channels} of {old.out_channels} channels, relative squared error {error:.4f}", flush=True)
            maps = Maps(one_by_one(lambda x: F.relu(old(x)), maps.large), one_by_one(lambda x: F.relu(fresh(x)), maps.new))
        return maps

    for index, pair in enumerate(zip(network.encoder, new.encoder)):
        skips.append(maps)
        maps = level(*pair, maps, f"encoder.{index}").each(lambda x: F.max_pool2d(x, 2))
    maps = level(network.bottom, new.bottom, maps, "bottom")
    for index, pair in enumerate(zip(network.decoder, new.decoder)):
        maps = maps.each(lambda x: F.interpolate(x, scale_factor=2, mode="nearest")).beside(skips.pop())
        maps = level(*pair, maps, f"decoder.{index}")
    fit(network.head, new.head, maps, torch.arange(network.head.out_channels))


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="exported U-Net")
    parser.add_argument("--size", choices=[*SIZES], required=True, help="size of the new network: as many convolutions, fewer channels")
    parser.add_argument("--data", type=Path, required=True, help="data set whose training views the layers are fitted to")
    parser.add_argument("-o", "--output", type=Path, required=True, help="exported file with the new weights")
    options = parser.parse_args()
    bundle = load(options.model)
    if not isinstance(bundle.model, Unet):
        parser.error(f"{options.model}: not a U-Net")
    new = Unet(dataclasses.replace(bundle.model.config, size=options.size)).eval()
    shapes = [[len(level.convs) for level in (*network.encoder, network.bottom, *network.decoder)] for network in (bundle.model, new)]
    if shapes[0] != shapes[1]:
        parser.error(f"size {bundle.model.config.size} has other layers than {options.size}")
    prune(bundle.model, new, crops(bundle, options.data))
    bundle.model = new
    bundle.meta["model"]["size"] = options.size
    save_file(bundle.tensors(), options.output, metadata={"demc": json.dumps(bundle.meta)})


if __name__ == "__main__":
    main()
