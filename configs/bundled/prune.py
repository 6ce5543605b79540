"""Makes a U-Net with fewer channels from a trained one, as a start for training.

    python configs/bundled/prune.py LARGE.safetensors --size medium --data DATA -o PRUNED.safetensors
    demc-infer import PRUNED.safetensors -o START.safetensors

Layer by layer, from the input to the output: the channels whose output counts most in the next layers stay.
Ridge regression on crops of training views fits the new layer to the large network's maps of these channels.
It sees the new network's own maps, so each layer also corrects what the layers before it lost. It is drawn to
the large network's weights, as strongly as suits crops that it does not see. An albedo filter stays. Needs
numpy, OpenEXR, torch, and safetensors.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
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

CROPS, SIDE = 96, 192
ASIDE = 4
"""Each fourth crop decides about the strength of the regression."""
PIXELS = 60_000
"""Pixels that a layer is fitted to and tried on."""
STRENGTHS = 1e-4, 1e-3, 1e-2, 1e-1, 1.0
"""Relative to the mean square of an input."""


@dataclass
class Maps:
    """What a layer reads: the maps [N, C, H, W] of the large network and of the new one."""

    large: Tensor
    new: Tensor
    kept: Tensor
    """The large network's channels that the new one has."""

    def each(self, change: Callable[[Tensor], Tensor]) -> Maps:
        return Maps(change(self.large), change(self.new), self.kept)

    def beside(self, skip: Maps) -> Maps:
        kept = torch.cat((self.kept, skip.kept + self.large.shape[1]))
        return Maps(torch.cat((self.large, skip.large), 1), torch.cat((self.new, skip.new), 1), kept)


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


def one_by_one(change: Callable[[Tensor], Tensor], maps: Tensor) -> Tensor:
    return torch.cat([change(image[None]) for image in maps])


def fit(old: nn.Conv2d, new: nn.Conv2d, maps: Maps, wanted: Tensor, kept: Tensor) -> str:
    """Sets the new convolution so that its output is `wanted`, the old one's of the kept channels."""
    rng = torch.Generator().manual_seed(1)
    squares, products, tried = 0, 0, []
    start = torch.cat((old.weight[kept][:, maps.kept].flatten(1), old.bias[kept, None]), 1).T.double()
    for number, (small, image) in enumerate(zip(maps.new, wanted)):
        chosen = torch.randperm(small[0].numel(), generator=rng)[: PIXELS // len(maps.new)]
        inputs = F.unfold(small[None], 3, padding=1)[0][:, chosen]
        inputs = torch.cat((inputs, torch.ones(1, len(chosen)))).T.double()
        outputs = image[kept].flatten(1)[:, chosen].T.double()
        if number % ASIDE == 0:
            tried.append((inputs, outputs))
        else:
            squares = squares + inputs.T @ inputs
            products = products + inputs.T @ (outputs - inputs @ start)
    mean = squares.diagonal().mean()
    inputs, outputs = (torch.cat(part) for part in zip(*tried))

    def solved(strength: float) -> Tensor:
        ridge = squares + strength * mean * torch.eye(len(squares), dtype=torch.float64)
        return start + torch.cholesky_solve(products, torch.linalg.cholesky(ridge))

    def error(weights: Tensor) -> float:
        return float(((inputs @ weights - outputs) ** 2).mean() / outputs.var(0).mean())

    best = min(map(solved, STRENGTHS), key=error)
    new.weight.copy_(best[:-1].T.reshape(new.weight.shape))
    new.bias.copy_(best[-1])
    return f"{len(kept)} of {old.out_channels} channels, relative squared error {error(start):.4f}, fitted {error(best):.4f}"


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
    maps = Maps(images, images, torch.arange(images.shape[1]))
    skips: list[Maps] = []
    following = readers(network)

    def level(old_level: nn.Module, new_level: nn.Module, maps: Maps, name: str) -> Maps:
        for number, (old, fresh) in enumerate(zip(old_level.convs, new_level.convs)):
            wanted = one_by_one(old, maps.large)
            weight = sum(weights.square().sum((0, 2, 3)) for weights in next(following)).sqrt()
            size = torch.stack([F.relu(image).square().mean((1, 2)) for image in wanted]).mean(0).sqrt()
            kept = (size * weight).topk(fresh.out_channels).indices.sort().values
            print(f"{name}.{number}: {fit(old, fresh, maps, wanted, kept)}", flush=True)
            maps = Maps(F.relu_(wanted), F.relu_(one_by_one(fresh, maps.new)), kept)
        return maps

    for index, pair in enumerate(zip(network.encoder, new.encoder)):
        skips.append(maps)
        maps = level(*pair, maps, f"encoder.{index}").each(lambda x: F.max_pool2d(x, 2))
    maps = level(network.bottom, new.bottom, maps, "bottom")
    for index, pair in enumerate(zip(network.decoder, new.decoder)):
        maps = maps.each(lambda x: F.interpolate(x, scale_factor=2, mode="nearest")).beside(skips.pop())
        maps = level(*pair, maps, f"decoder.{index}")
    wanted = one_by_one(network.head, maps.large)
    print("head:", fit(network.head, new.head, maps, wanted, torch.arange(wanted.shape[1])))


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
