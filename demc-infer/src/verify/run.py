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
    import ctypes

    import pyoidn

    folder = Path(pyoidn.__file__).parent / "oidn" / "lib"
    library = ctypes.CDLL(str(next(path for path in sorted(folder.iterdir()) if "OpenImageDenoise.so" in path.name)))
    for name, result in (("oidnNewDevice", ctypes.c_void_p), ("oidnNewFilter", ctypes.c_void_p)):
        getattr(library, name).restype = result
    pointer, size, text = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_char_p
    library.oidnCommitDevice.argtypes = [pointer]
    library.oidnNewFilter.argtypes = [pointer, text]
    library.oidnSetSharedFilterImage.argtypes = [pointer, text, pointer, ctypes.c_int, size, size, size, size, size]
    library.oidnSetSharedFilterData.argtypes = [pointer, text, pointer, size]
    library.oidnSetFilterBool.argtypes = [pointer, text, ctypes.c_bool]
    for function in (library.oidnCommitFilter, library.oidnExecuteFilter, library.oidnReleaseFilter):
        function.argtypes = [pointer]
    library.oidnGetDeviceError.argtypes = [pointer, ctypes.POINTER(text)]
    weights = numpy.fromfile(file, numpy.uint8)
    cpu, float3 = 1, 3
    device = library.oidnNewDevice(cpu)
    library.oidnCommitDevice(device)

    def denoise(color, features):
        planes = {"color": color, "albedo": features[6:9], "normal": features[:3], "output": numpy.empty_like(color)}
        images = {name: numpy.ascontiguousarray(image.transpose(1, 2, 0)) for name, image in planes.items()}
        handle = library.oidnNewFilter(device, b"RT")
        for name in ("color", *guides, "output"):
            height, width, _ = images[name].shape
            data = images[name].ctypes.data
            library.oidnSetSharedFilterImage(handle, name.encode(), data, float3, width, height, 0, 0, 0)
        library.oidnSetFilterBool(handle, b"hdr", True)
        library.oidnSetSharedFilterData(handle, b"weights", weights.ctypes.data, weights.nbytes)
        library.oidnCommitFilter(handle)
        library.oidnExecuteFilter(handle)
        library.oidnReleaseFilter(handle)
        message = text()
        if library.oidnGetDeviceError(device, ctypes.byref(message)):
            raise RuntimeError(message.value.decode())
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
