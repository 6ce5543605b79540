"""Prints the contents of a directory of event files as JSON, read by both accumulators of `tensorboard`."""

import json
import math
import sys

from tensorboard.backend.event_processing import event_accumulator, plugin_event_accumulator
from tensorboard.util import tensor_util


def number(value):
    """A value for JSON, which has no NaN and no infinity."""
    value = float(value)
    return value if math.isfinite(value) else str(value)


def text(tensor):
    return tensor_util.make_ndarray(tensor).item().decode()


def classic(path):
    """The documented way to read event files from Python."""
    keep_all = {kind: 0 for kind in event_accumulator.DEFAULT_SIZE_GUIDANCE}
    events = event_accumulator.EventAccumulator(path, size_guidance=keep_all).Reload()
    tags = events.Tags()
    text_tags = events.PluginTagToContent("text")
    assert sorted(tags["tensors"]) == sorted(text_tags), tags
    return {
        "scalars": {
            tag: [[e.step, number(e.value)] for e in events.Scalars(tag)] for tag in tags["scalars"] if events.Scalars(tag)
        },
        "images": {
            tag: [[e.step, e.width, e.height, e.encoded_image_string.hex()] for e in events.Images(tag)]
            for tag in tags["images"]
        },
        "text": {tag: [[e.step, text(e.tensor_proto)] for e in events.Tensors(tag)] for tag in text_tags},
    }


def plugin(path):
    """The reader of TensorBoard without its data server: every value is a tensor of a plugin."""
    keep_all = {name: 0 for name in ["scalars", "images", "text"]}
    events = plugin_event_accumulator.EventAccumulator(path, tensor_size_guidance=keep_all).Reload()
    found = {"scalars": {}, "images": {}, "text": {}}
    for tag in events.Tags()["tensors"]:
        name = events.SummaryMetadata(tag).plugin_data.plugin_name
        series = []
        for event in events.Tensors(tag):
            tensor = event.tensor_proto
            if name == "scalars":
                series.append([event.step, number(tensor_util.make_ndarray(tensor).item())])
            elif name == "images":
                width, height, png = tensor_util.make_ndarray(tensor)
                series.append([event.step, int(width), int(height), png.hex()])
            else:
                series.append([event.step, text(tensor)])
        if series:
            found[name][tag] = series
    return found


json.dump({"classic": classic(sys.argv[1]), "plugin": plugin(sys.argv[1])}, sys.stdout)
