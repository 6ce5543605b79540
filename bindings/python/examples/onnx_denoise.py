"""Denoises an EXR file of any renderer with an ONNX file of `demc-infer export`.

pip install onnxruntime OpenEXR ./bindings/python (in the repository root). PyTorch is not used.
"""

import argparse
import json
import sys

import demc.torch
import onnxruntime

parser = argparse.ArgumentParser(description=__doc__)
for name in ("model", "input", "output"):
    parser.add_argument(name)
parser.add_argument("--layout", help="preset or TOML file of the channels; default: the one that fits")
parser.add_argument("--layer", help="view layer, for a file with several")
arguments = parser.parse_args()

session = onnxruntime.InferenceSession(arguments.model, providers=["CPUExecutionProvider"])
meta = json.loads(session.get_modelmeta().custom_metadata_map["demc"])
try:
    frame = demc.torch.read_exr(arguments.input, arguments.layout, arguments.layer, meta)
    print(frame.layout.describe())
    color, features, scale = demc.torch.preprocess.prepare(frame.color, frame.features, meta)
    color, features = (demc.torch.preprocess.pad(image, meta)[None] for image in (color, features))
    [output] = session.run(["output"], {"color": color, "features": features})
    height, width = frame.color.shape[1:]
    image = output[0, :, :height, :width] / scale
    image *= demc.torch.light.factors(frame.color, image, meta)
    frame.write(arguments.output, image, precision="float")
except (OSError, ValueError) as error:
    sys.exit(f"error: {error}")
