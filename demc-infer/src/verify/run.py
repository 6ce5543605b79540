"""Runs an exported file on the batches of a folder. Arguments: KIND FILE FOLDER; on stdin, shapes and guides as JSON.

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


def oidn(file):
    import pyoidn
    from pyoidn.capi import oidn_Capi, oidn_ffi

    # `pyoidn` has no method for weights.
    oidn_ffi.cdef("void oidnSetSharedFilterData(OIDNFilter filter, const char* name, void* data, size_t size);")
    weights = Path(file).read_bytes()
    device = pyoidn.Device(pyoidn.OIDN_DEVICE_TYPE_CPU)
    device.commit()

    def denoise(color, features):
        planes = {"color": color, "albedo": features[6:9], "normal": features[:3], "output": numpy.empty_like(color)}
        images = {name: numpy.ascontiguousarray(image.transpose(1, 2, 0)) for name, image in planes.items()}
        filter = pyoidn.Filter(device, "RT")
        for name in ("color", *guides, "output"):
            filter.set_image(name, images[name], pyoidn.OIDN_FORMAT_FLOAT3)
        filter.set_bool("hdr", True)
        data = oidn_ffi.from_buffer(weights)
        oidn_Capi.oidnSetSharedFilterData(filter._filter, b"weights", data, len(weights))
        filter.commit()
        filter.execute()
        error = device.get_error()
        filter.release()
        if error is not None:
            raise RuntimeError(error)
        return images["output"].transpose(2, 0, 1)

    version = "Open Image Denoise of pyoidn"
    return version, lambda color, features: numpy.stack([denoise(*image) for image in zip(color, features)])


kind, file, folder = sys.argv[1:]
request = json.load(sys.stdin)
guides = request["guides"]
try:
    import numpy

    version, run = {"onnx": onnx, "torch": torch, "oidn": oidn}[kind](file)
except ImportError as error:
    print(error, file=sys.stderr)
    sys.exit(3)
for i, (batch, height, width) in enumerate(request["sizes"]):
    path = Path(folder, str(i))
    color, features = (
        numpy.fromfile(path.with_suffix(suffix), "<f4").reshape(batch, -1, height, width)
        for suffix in (".color", ".features")
    )
    run(color, features).astype("<f4").tofile(path.with_suffix(".output"))
print(version)
