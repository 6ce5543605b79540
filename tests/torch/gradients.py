"""Computes the gradients of a bundle's weights with PyTorch, for the mean square of its output: `BUNDLE INPUT OUTPUT`.

INPUT is a safetensors file with `color_gamma` and `features_z`, as for `python -m demc.torch`; OUTPUT gets a gradient for
each weight. Batch normalisation uses the statistics of the batch.
"""

import sys

import demc.torch
from safetensors.torch import load_file, save_file

bundle, source, output = sys.argv[1:]
model = demc.torch.load(bundle).model.train()
images = load_file(source)
model(images["color_gamma"], images["features_z"]).square().mean().backward()
save_file({name: weight.grad for name, weight in model.named_parameters()}, output)
