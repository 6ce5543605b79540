"""`python -m demc BUNDLE` describes an exported bundle; with INPUT and OUTPUT it also runs its network.

INPUT is a safetensors file with `color_gamma` [B, 3, H, W] and `features_z` [B, 12, H, W], as the network takes them;
OUTPUT gets `output` [B, 3, H, W], gamma space.
"""

import argparse
import sys

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from . import load


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m demc", description=__doc__)
    parser.add_argument("bundle", help="file that demc-infer exported")
    parser.add_argument("input", nargs="?")
    parser.add_argument("output", nargs="?")
    arguments = parser.parse_args()
    if (arguments.input is None) != (arguments.output is None):
        parser.error("INPUT and OUTPUT go together")

    try:
        bundle = load(arguments.bundle)
        if arguments.input:
            tensors = load_file(arguments.input)
            if missing := {"color_gamma", "features_z"} - tensors.keys():
                raise ValueError(f"{arguments.input}: no tensor {' and no '.join(sorted(missing))}")
            with torch.inference_mode():
                output = bundle.model(tensors["color_gamma"], tensors["features_z"])
            save_file({"output": output.contiguous()}, arguments.output)
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1

    parameters = sum(p.numel() for p in bundle.model.parameters())
    print(f"{bundle.model.config}, {parameters:,} parameters, step {bundle.step}")
    return 0


sys.exit(main())
