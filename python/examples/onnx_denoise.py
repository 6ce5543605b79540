"""Denoises an image with an ONNX file of `demc-infer export`: MODEL.onnx IN.exr OUT.exr

pip install numpy onnxruntime OpenEXR
"""

import json
import sys

import numpy as np
import onnxruntime
import OpenEXR

model, source, target = sys.argv[1:]
session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
meta = json.loads(session.get_modelmeta().custom_metadata_map["demc"])
layout = meta["layout"]
channels = OpenEXR.File(source, separate_channels=True).channels()


def planes(*buffers):
    """Buffers of the layout, [1, C, H, W]; edges repeated to multiples of 32."""
    image = np.stack([channels[name].pixels for buffer in buffers for name in layout[buffer]])
    height, width = image.shape[1:]
    return np.pad(image, ((0, 0), (0, -height % 32), (0, -width % 32)), "edge")[None].astype("f4")


# An unusual exposure is scaled to the middle of the training scenes' exposures.
red, green, blue = (channels[name].pixels.astype("f4").clip(0) for name in layout["color"])
luminance = 0.2126 * red + 0.7152 * green + 0.0722 * blue
exposure = np.mean(luminance ** (1 / 2.2)) ** 2.2
low, high = (meta["ranges"]["exposure"][end] for end in ("low", "high"))
scale = np.float32(1 if exposure == 0 or low / 2 <= exposure <= high * 2 else (low * high) ** 0.5 / exposure)
features = planes("normal", "position", "texture1", "texture2")
[output] = session.run(["output"], {"color": planes("color") * scale, "features": features})
output /= scale
height, width = red.shape
rgb = np.ascontiguousarray(output[0, :, :height, :width].transpose(1, 2, 0))
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
OpenEXR.File(header, {"RGB": rgb}).write(target)
