"""Runs an exported file on the batches of a folder. Arguments: KIND FILE FOLDER; shapes as JSON on stdin.

Batch i is `i.color` and `i.features` as raw float32; the result is `i.output`. Exit code 3: a package is missing.
"""

import json
import sys
from pathlib import Path

# With `-c`, the first entry is the working directory, where a user's file could shadow a package.
sys.path = [entry for entry in sys.path if entry]


def onnx(file):
    import onnxruntime

    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    version = f"ONNX Runtime {onnxruntime.__version__}"
    return version, lambda color, features: session.run(["output"], {"color": color, "features": features})[0]


def torch(file):
    import demc.torch
    import torch

    bundle = demc.torch.load(file)
    version = f"PyTorch {torch.__version__}"
    if bundle.model.config.variant == "kpcn":
        return version, lambda *inputs: bundle.model(*map(torch.from_numpy, inputs)).numpy(force=True)
    return version, lambda color, features: numpy.stack([bundle.denoise(*image) for image in zip(color, features)])


kind, file, folder = sys.argv[1:]
try:
    import numpy

    version, run = {"onnx": onnx, "torch": torch}[kind](file)
except ImportError as error:
    print(error, file=sys.stderr)
    sys.exit(3)
for i, (batch, height, width) in enumerate(json.load(sys.stdin)):
    path = Path(folder, str(i))
    color, features = (
        numpy.fromfile(path.with_suffix(suffix), "<f4").reshape(batch, -1, height, width)
        for suffix in (".color", ".features")
    )
    run(color, features).astype("<f4").tofile(path.with_suffix(".output"))
print(version)
