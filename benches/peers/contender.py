"""A peer for `run.py`. It reads commands from stdin and answers each with a line of JSON.

The commands are those of this project's contender (`benches/src/main.rs`), and `warm`:

    (start)      {"ready": description}
    check FILE   inference: {"zeros": share}, the output in FILE; training: {"losses", "grad_norms"} of 3 steps
    warm         {"choice": the fastest implementation}; all compilation ends here
    step N       {"seconds": of one step, on average}
    memory       {"peak_mib": peak of the resident set}

`contender.py export` writes the ONNX file in a separate process, so that its memory does not count for the runtime.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Callable

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bindings" / "python"))

NAMES = ("color_gamma", "features_z")
CHECK_STEPS = 3  # the third loss depends on two updates of the weights
WARM_SECONDS = 1.0  # minimum warm-up before timing, with at least two steps
QUICK_WARM_SECONDS = 0.05


class TorchTraining:
    """Forward, loss, backward and Adam of the PyTorch implementation in bindings/python/."""

    ADAMS = {"fused": {"fused": True}, "foreach": {"foreach": True}}

    def __init__(self, args: argparse.Namespace) -> None:
        self.torch, self.model, self.inputs = load_torch(args)
        self.dtype, self.device, self.lr, self.quick = args.dtype, args.device, args.lr, args.quick
        self.model.train()
        self.start = {name: value.clone() for name, value in self.model.state_dict().items()}
        self.forward = self.torch.compile(self.model) if args.kind == "compile" else self.model
        self.reset("foreach")

    def about(self) -> str:
        return f"PyTorch {self.torch.__version__}"

    def reset(self, adam: str) -> None:
        """Restores the initial weights, with a new Adam (Sec. 4.2)."""
        self.model.load_state_dict(self.start)
        self.adam = self.torch.optim.Adam(
            self.model.parameters(), lr=self.lr, betas=(0.9, 0.999), eps=1e-8, **self.ADAMS[adam]
        )

    def loss(self):
        import demc.torch

        color, features, reference = self.inputs
        with autocast(self.torch, self.device, self.dtype):
            output = self.forward(color, features)
        return demc.torch.rel_mse(demc.torch.hdr_from_gamma(output.float()), reference)

    def step(self) -> float:
        self.adam.zero_grad()
        loss = self.loss()
        loss.backward()
        self.adam.step()
        return loss.item()

    def check(self, _path: str) -> dict:
        answers = []
        for adam in self.ADAMS:
            self.reset(adam)
            losses, norms = [], []
            for _ in range(CHECK_STEPS):
                losses.append(self.step())
                norms.append(self.torch.stack([p.grad.norm() for p in self.model.parameters()]).norm().item())
            answers.append({"losses": losses, "grad_norms": norms})
        first, second = (a["losses"] for a in answers)
        if any(abs(a - b) > 1e-3 * abs(a) for a, b in zip(first, second)):
            raise RuntimeError(f"the implementations of Adam differ: {first} and {second}")
        return answers[0]

    def warm(self) -> str:
        seconds = {}
        for adam in self.ADAMS:
            self.reset(adam)
            warm_up(self.step, self.quick)
            seconds[adam] = min(timed(self.step) for _ in range(3))
        best = min(seconds, key=seconds.get)
        self.reset(best)
        warm_up(self.step, self.quick)
        return f"Adam {best}"


class Inference:
    """Base class of inferences: `run` returns the output as a NumPy array."""

    run: Callable
    quick: bool
    step = property(lambda self: self.run)

    def check(self, path: str) -> dict:
        from safetensors.numpy import save_file

        output = self.run()
        save_file({"output": output}, path)
        return {"zeros": float((output == 0).mean())}

    def warm(self) -> str:
        warm_up(self.run, self.quick)
        return ""


class TorchInference(Inference):
    def __init__(self, args: argparse.Namespace) -> None:
        torch, model, inputs = load_torch(args)
        model.eval()
        forward = torch.compile(model) if args.kind == "compile" else model

        def run():
            with torch.inference_mode(), autocast(torch, args.device, args.dtype):
                return forward(*inputs[:2]).float().contiguous().cpu().numpy()

        self.run, self.version, self.quick = run, torch.__version__, args.quick

    def about(self) -> str:
        return f"PyTorch {self.version}"


class OnnxRuntimeInference(Inference):
    def __init__(self, args: argparse.Namespace) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = args.threads, 1
        session = onnxruntime.InferenceSession(args.onnx, options, providers=["CPUExecutionProvider"])
        inputs = load_numpy(args.inputs)
        self.run, self.quick = lambda: session.run(None, inputs)[0], args.quick
        self.version = onnxruntime.__version__

    def about(self) -> str:
        return f"ONNX Runtime {self.version}"


class OpenVinoInference(Inference):
    def __init__(self, args: argparse.Namespace) -> None:
        import openvino

        # f32, because the default is bf16 on processors that support it.
        options = {
            "INFERENCE_NUM_THREADS": args.threads,
            "NUM_STREAMS": 1,
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": "f32",
        }
        request = openvino.Core().compile_model(args.onnx, "CPU", options).create_infer_request()
        inputs = load_numpy(args.inputs)
        self.run, self.quick = lambda: request.infer(inputs)[0].copy(), args.quick
        self.version = openvino.__version__.split("-")[0]

    def about(self) -> str:
        return f"OpenVINO {self.version}"


def load_torch(args: argparse.Namespace):
    """Returns torch, the model with the case's weights, and the three inputs, in the layout of `args.kind`."""
    import torch
    from safetensors.torch import load_file

    import demc.torch

    torch.set_num_threads(args.threads)
    precision = "tf32" if args.dtype == "tf32" else "ieee"
    torch.backends.cuda.matmul.fp32_precision = torch.backends.cudnn.conv.fp32_precision = precision
    torch.backends.cudnn.benchmark = True
    layout = torch.contiguous_format if args.kind == "nchw" else torch.channels_last
    model = demc.torch.load(args.weights).model.to(device=args.device, memory_format=layout)
    tensors = load_file(args.inputs)
    inputs = [tensors[name].to(device=args.device, memory_format=layout) for name in (*NAMES, "reference_hdr")]
    return torch, model, inputs


def load_numpy(path: str) -> dict:
    from safetensors.numpy import load_file

    tensors = load_file(path)
    return {name: tensors[name] for name in NAMES}


def autocast(torch, device: str, dtype: str):
    return torch.autocast(device.split(":")[0], dtype=torch.bfloat16, enabled=dtype == "bf16")


def export(args: argparse.Namespace) -> None:
    """Exports the network with fixed sizes, which the runtimes execute fastest."""
    import torch

    args.kind, args.device, args.dtype = "nchw", "cpu", "f32"
    _, model, inputs = load_torch(args)
    # The older exporter, which warns about its age, but does not need `onnxscript`.
    torch.onnx.export(
        model.eval(), tuple(inputs[:2]), args.onnx, dynamo=False, opset_version=17, input_names=list(NAMES)
    )


def timed(step: Callable) -> float:
    started = time.perf_counter()
    step()
    return time.perf_counter() - started


def warm_up(step: Callable, quick: bool) -> None:
    started, steps = time.perf_counter(), 0
    while steps < 2 or time.perf_counter() - started < (QUICK_WARM_SECONDS if quick else WARM_SECONDS):
        step()
        steps += 1


def peak_mib() -> float | None:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


def serve(contender, say: Callable[[dict], None]) -> None:
    say({"ready": contender.about()})
    for line in sys.stdin:
        command, _, argument = line.strip().partition(" ")
        if command == "check":
            say(contender.check(argument))
        elif command == "warm":
            say({"choice": contender.warm()})
        elif command == "step":
            started = time.perf_counter()
            for _ in range(int(argument)):
                contender.step()
            say({"seconds": (time.perf_counter() - started) / int(argument)})
        elif command == "memory":
            say({"peak_mib": peak_mib()})
        else:
            raise ValueError(f"unknown command {line!r}")


CONTENDERS = {
    ("train", "torch"): TorchTraining,
    ("infer", "torch"): TorchInference,
    ("infer", "onnxruntime"): OnnxRuntimeInference,
    ("infer", "openvino"): OpenVinoInference,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=("train", "infer", "export"))
    parser.add_argument("--runtime", choices=("torch", "onnxruntime", "openvino"), default="torch")
    parser.add_argument("--kind", choices=("nchw", "channels_last", "compile"), default="nchw")
    parser.add_argument("--weights")
    parser.add_argument("--inputs")
    parser.add_argument("--onnx")
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--lr", type=float)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", choices=("f32", "tf32", "bf16"), default="f32")
    parser.add_argument("--quick", action="store_true", help="short warm-up")
    args = parser.parse_args()

    # Output of libraries must not mix with the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    if args.mode == "export":
        export(args)
        return

    def say(answer: dict) -> None:
        print(json.dumps(answer), file=answers, flush=True)

    serve(CONTENDERS[args.mode, args.runtime](args), say)


if __name__ == "__main__":
    main()
