"""Denoises an EXR file of any renderer in PyTorch with a bundle of `demc-infer export`.

pip install './bindings/python[torch]' (in the repository root)
"""

import argparse
import sys

import demc.torch

parser = argparse.ArgumentParser(description=__doc__)
for name in ("model", "input", "output"):
    parser.add_argument(name)
parser.add_argument("--layout", help="preset or TOML file of the channels; default: the one that fits")
parser.add_argument("--layer", help="view layer, for a file with several")
parser.add_argument("--layers", action="append", default=[], metavar="PATTERN", help="also denoise these channels")
arguments = parser.parse_args()

try:
    bundle = demc.torch.load(arguments.model)
    frame = demc.torch.read_exr(arguments.input, arguments.layout, arguments.layer, bundle)
    print(frame.layout.describe())
    image, layers = bundle.denoise_with_layers(frame.color, frame.features, frame.layers(*arguments.layers))
    frame.write(arguments.output, image, precision="float", layers=layers)
except (OSError, ValueError) as error:
    sys.exit(f"error: {error}")
