"""Checks the structure of ONNX files and runs them: `FOLDER`.

FOLDER holds `NAME.onnx`, `sizes.json` with one `[batch, height, width]` per case, and `CASE.color` and `CASE.features` as
raw float32. The script writes `NAME.CASE.output`.
"""

import json
import sys
from pathlib import Path

import numpy
import onnx
import onnxruntime
from onnx.tools.update_model_dims import update_inputs_outputs_dims

OPERATORS = {"Relu", "Pow", "Sub", "Div", "Conv", "ConvTranspose", "MaxPool", "Min", "Concat", "Cast", "Mul", "Slice", "Add"}
KERNEL_HEAD = {"AveragePool", "Greater", "Max", "Pad", "ReduceSum", "Reshape", "Resize", "Shape", "Sigmoid", "Softmax"}
"""Operators of a kernel head."""
FILTER = {"Clip", "ReduceMax", "ReduceMin", "Greater", "Where"}
SHAPES = {"color": ["batch", 3, "height", "width"], "features": ["batch", 12, "height", "width"]}
OUTPUT = ["batch", 3, "height", "width"]


def shape(value) -> list:
    return [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]


def check_structure(path: Path) -> None:
    onnx.checker.check_model(str(path), full_check=True)
    model = onnx.load(path)
    assert [(o.domain, o.version) for o in model.opset_import] == [("", 17)]
    operators = {node.op_type for node in model.graph.node}
    has_filter = path.stem.endswith("-filter")
    assert operators <= OPERATORS | KERNEL_HEAD | (FILTER if has_filter else set())
    assert {value.name: shape(value) for value in model.graph.input} == SHAPES
    assert {value.name: shape(value) for value in model.graph.output} == {"output": OUTPUT}
    meta = {entry.key: entry.value for entry in model.metadata_props}
    bundle = json.loads(meta["demc"])
    networks = [bundle, bundle.get("albedo_filter", bundle)]
    assert ("Softmax" in operators) == any(network["model"]["head"] == "kernel" for network in networks)
    assert path.stem.startswith(f"{bundle['model']['variant']}-{bundle['model']['reading']}-"), path
    assert bundle["normalizer"]["gamma"] == 2.2 and len(bundle["normalizer"]["features"]["std"]) == 12
    assert len(json.loads(meta["demc.features"])) == 12
    assert ("albedo_filter" in bundle) == has_filter
    assert bundle["layout"]["color"] == ["R", "G", "B"] and bundle["step"] == model.model_version

    # With fixed input sizes, shape inference must determine every shape, including the output.
    sizes = {"color": [2, 3, 96, 160], "features": [2, 12, 96, 160]}
    fixed = update_inputs_outputs_dims(model, sizes, {"output": ["b", 3, "h", "w"]})
    inferred = onnx.shape_inference.infer_shapes(fixed, check_type=True, strict_mode=True, data_prop=True)
    known = {value.name: shape(value) for value in inferred.graph.value_info}
    for node in inferred.graph.node:
        assert node.output[0] == "output" or all(isinstance(n, int) and n > 0 for n in known[node.output[0]]), node
    assert known["output_gamma"] == [2, 3, 96, 160]


def main() -> None:
    folder = Path(sys.argv[1])
    sizes = json.loads((folder / "sizes.json").read_text())
    for path in sorted(folder.glob("*.onnx")):
        check_structure(path)
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        for case, (batch, height, width) in enumerate(sizes):
            inputs = {
                name: numpy.fromfile(folder / f"{case}.{name}", "<f4").reshape(batch, channels, height, width)
                for name, (_, channels, *_) in SHAPES.items()
            }
            output = session.run(["output"], inputs)[0]
            assert output.dtype == numpy.float32 and output.shape == (batch, 3, height, width)
            output.tofile(folder / f"{path.stem}.{case}.output")
        onnxruntime.set_default_logger_severity(4)  # the errors below are expected
        for height, width in [(32, 48), (33, 32), (64, 16)]:
            inputs = {name: numpy.ones((1, s[1], height, width), "f4") for name, s in SHAPES.items()}
            try:
                session.run(None, inputs)
            except Exception as error:
                assert "Concat" in str(error) or "concat" in str(error), error
            else:
                raise AssertionError(f"{path.stem}: {height}x{width} was not refused")


main()
