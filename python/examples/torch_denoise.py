"""Denoises an image with a file that `demc-infer export` wrote, in PyTorch: MODEL.safetensors IN.exr OUT.exr

pip install ./python OpenEXR, from the repository's root
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
    """[C, H, W] of a layout's buffers."""
    return np.stack([channels[name].pixels for buffer in buffers for name in layout[buffer]])


image = bundle.denoise(planes("color"), planes("normal", "position", "texture1", "texture2"))
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
OpenEXR.File(header, {"RGB": np.ascontiguousarray(image.transpose(1, 2, 0))}).write(target)
