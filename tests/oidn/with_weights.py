"""Denoises an OpenEXR file in Open Image Denoise with weights of `demc-infer export`.

    pip install numpy OpenEXR pyoidn
    python with_weights.py unet.tza noisy.exr denoised.exr

The file has the channels of this project: R, G, B, albedo1.R and so on, normal.X and so on. `pyoidn` has no
method for weights, so this calls the function of OIDN's C interface.
"""

import sys

import numpy as np
import OpenEXR
import pyoidn
from pyoidn.capi import oidn_Capi, oidn_ffi

oidn_ffi.cdef("void oidnSetSharedFilterData(OIDNFilter filter, const char* name, void* data, size_t size);")


def main(weights: str, source: str, target: str) -> None:
    with OpenEXR.File(source, separate_channels=True) as file:
        channels = {name: channel.pixels.astype(np.float32) for name, channel in file.channels().items()}
    layers = {"color": ("", "RGB"), "albedo": ("albedo1.", "RGB"), "normal": ("normal.", "XYZ")}
    images = {name: np.stack([channels[layer + end] for end in ends], axis=-1) for name, (layer, ends) in layers.items()}
    output = np.empty_like(images["color"])
    with open(weights, "rb") as file:
        data = file.read()  # OIDN reads it while the filter exists.
    device = pyoidn.Device()
    device.commit()
    filter = pyoidn.Filter(device, "RT")
    for name, image in {**images, "output": output}.items():
        filter.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
    filter.set_bool("hdr", True)
    oidn_Capi.oidnSetSharedFilterData(filter._filter, b"weights", oidn_ffi.from_buffer(data), len(data))
    filter.commit()
    filter.execute()
    error = device.get_error()
    filter.release()
    device.release()
    if error is not None:
        sys.exit(f"Open Image Denoise: {error}")
    header = {"type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": output}) as file:
        file.write(target)


if __name__ == "__main__":
    main(*sys.argv[1:])
