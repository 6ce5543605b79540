"""Describe an exported bundle, and run its network on INPUT if given.

INPUT is a safetensors file with the network's inputs: `color_gamma` [B, 3, H, W] and
`features_z` [B, 12, H, W]. OUTPUT will contain `output` [B, 3, H, W], in gamma space. KPCN takes
light [B, 6, H, W] as `color_gamma`, and so its output is.
"""

import argparse
import sys

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from . import load


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m demc.torch", description=__doc__)
    parser.add_argument("bundle", help="file written by demc-infer export")
    parser.add_argument("input", nargs="?", help="safetensors file with color_gamma and features_z")
    parser.add_argument("output", nargs="?", help="safetensors file for the output")
    arguments = parser.parse_args()
    if (arguments.input is None) != (arguments.output is None):
        parser.error("INPUT requires OUTPUT")

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
