"""Denoises an image in PyTorch with a bundle of `demc-infer export`: MODEL.safetensors IN.exr OUT.exr

pip install ./python OpenEXR (in the repository root)
"""

import sys

import demc
import numpy as np
import OpenEXR

model, source, target = sys.argv[1:]
bundle = demc.load(model)
layout = bundle.meta["layout"]
channels = OpenEXR.File(source, separate_channels=True).channels()


def planes(*buffers):
    """Buffers of the layout, [C, H, W]."""
    return np.stack([channels[name].pixels for buffer in buffers for name in layout[buffer]])


image = bundle.denoise(planes("color"), planes("normal", "position", "texture1", "texture2"))
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
OpenEXR.File(header, {"RGB": np.ascontiguousarray(image.transpose(1, 2, 0))}).write(target)
