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
layout = json.loads(session.get_modelmeta().custom_metadata_map["demc"])["layout"]
channels = OpenEXR.File(source, separate_channels=True).channels()


def planes(*buffers):
    """Buffers of the layout, [1, C, H, W]; edges repeated to multiples of 32."""
    image = np.stack([channels[name].pixels for buffer in buffers for name in layout[buffer]])
    height, width = image.shape[1:]
    return np.pad(image, ((0, 0), (0, -height % 32), (0, -width % 32)), "edge")[None].astype("f4")


features = planes("normal", "position", "texture1", "texture2")
[output] = session.run(["output"], {"color": planes("color"), "features": features})
height, width = channels[layout["color"][0]].pixels.shape
rgb = np.ascontiguousarray(output[0, :, :height, :width].transpose(1, 2, 0))
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
OpenEXR.File(header, {"RGB": rgb}).write(target)
