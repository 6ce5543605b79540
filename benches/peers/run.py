"""Compares this project with PyTorch, ONNX Runtime and OpenVINO: the same network, weights, input and threads.

    cargo build --release -p demc-bench
    python3 -m venv .venv
    .venv/bin/pip install "torch>=2.9" numpy safetensors onnx onnxruntime openvino
    .venv/bin/python benches/peers/run.py --out peers.md --out peers.json

This script installs nothing. It names missing peers and leaves them out. torch.compile needs a C++ compiler. Cases are
training steps (forward, loss, backward, Adam) and inferences of DEMC in the paper's reading; `--list` names them.

Each contender is a separate process (`peer` of demc-bench, or `contender.py`) that computes on command. It is stopped
(SIGSTOP) between its turns. First, the results must agree: outputs of inference, or losses and gradient norms over 3
steps of Adam. Then each peer and this project take turns (A B A B), after a warm-up that is not timed.

A ratio is the peer's time over this project's in one round (above 1: this project is faster). The report gives the
ratio of the medians, and the minimum and maximum over the rounds. Memory is the peak of the resident set (VmHWM) over
the life of the process.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import signal
import statistics
import subprocess
import sys
import tempfile
from array import array
from dataclasses import dataclass
from pathlib import Path

from report import Comparison, Result, as_json, machine, markdown

HERE = Path(__file__).resolve().parent
LEARNING_RATE = 1e-4  # Sec. 4.2
QUICK_TURN_SECONDS = 0.05
QUIET = 0.05  # maximum share of the machine for other processes in a turn; above it, the report adds a note
TURN_SECONDS = 1.0  # a turn has as many steps as fit, at least one
# Maximum deviation of peers: outputs relative to their largest value; losses and norms relative to their value.
#
# f32: rounding takes 2e-6 of an output. After two steps of Adam it takes 2e-5 of a loss or norm at C = 16, and 4e-4 at
# C = 64. At ten times the learning rate it takes 4e-3. Adam's first step is equally long for all gradients, even for
# pure rounding noise.
#
# tf32 and bf16, on GPUs, keep 10 and 8 bits. Their bounds are estimates.
TOLERANCES = {"f32": (1e-4, 1e-3), "tf32": (1e-2, 5e-2), "bf16": (1e-1, 3e-1)}


@dataclass(frozen=True)
class Case:
    mode: str  # train | infer
    width: int
    size: tuple[int, int, int]  # batch, height, width; 1280x720 is padded to multiples of 32

    @property
    def name(self) -> str:
        batch, height, width = self.size
        images = f"{batch}x" if batch > 1 else ""
        return f"{self.mode}-{images}{width}x{height}-c{self.width}"

    @classmethod
    def parse(cls, name: str) -> Case:
        match = re.fullmatch(r"(train|infer)-(?:(\d+)x)?(\d+)x(\d+)-c(\d+)", name)
        if match is None:
            raise argparse.ArgumentTypeError(f"{name!r}: expected a name like train-4x128x128-c32 or infer-256x256-c32")
        mode, (batch, width, height, channels) = match[1], (int(group or 1) for group in match.groups()[1:])
        return cls(mode, channels, (batch, height, width))


CASES = [Case("train", c, (4, 128, 128)) for c in (16, 32, 64)]
CASES += [Case("infer", c, size) for size in ((1, 256, 256), (1, 736, 1280)) for c in (32, 64)]
QUICK = [Case("train", 4, (2, 64, 64)), Case("infer", 4, (1, 64, 96))]

TORCH_KINDS = ("nchw", "channels_last", "compile")


@dataclass
class Peer:
    """One runtime and configuration for the network."""

    name: str
    modes: tuple[str, ...]
    arguments: list[str]
    dtype: str = "f32"
    onnx: bool = False  # runs the exported network


def peers_of(device: str) -> list[Peer]:
    both = ("train", "infer")
    if device == "cpu":
        torch = [Peer(f"PyTorch {kind}", both, ["--kind", kind]) for kind in TORCH_KINDS]
        return torch + [
            Peer("ONNX Runtime", ("infer",), ["--runtime", "onnxruntime"], onnx=True),
            Peer("OpenVINO", ("infer",), ["--runtime", "openvino"], onnx=True),
        ]
    return [
        Peer(f"PyTorch {kind} {dtype}", both, ["--kind", kind, "--device", device, "--dtype", dtype], dtype)
        for dtype in TOLERANCES
        for kind in ("channels_last", "compile")
    ]


class Failed(Exception):
    """A contender ended, or answered with something else."""


class Contender:
    """A child process that computes on command and is stopped between commands."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self.errors = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            text=True,
            env=environment,
            start_new_session=True,  # a separate group that includes the processes of its compiler
        )
        try:
            self.about = self._answer()["ready"]
        except Failed:
            self.close()
            raise

    def step(self, count: int) -> tuple[float, float]:
        """Milliseconds per step over `count` steps, and the share of the machine used by other processes, 0 to 1."""
        busy, own, total = processor_time(self.process.pid)
        seconds = self.ask(f"step {count}")["seconds"]
        busy_after, own_after, total_after = processor_time(self.process.pid)
        others = (busy_after - busy) - (own_after - own)
        return 1e3 * seconds, max(0.0, others / max(1, total_after - total))

    def ask(self, command: str) -> dict:
        os.killpg(self.process.pid, signal.SIGCONT)
        try:
            print(command, file=self.process.stdin, flush=True)
        except BrokenPipeError:
            pass  # reading the answer raises the cause
        return self._answer()

    def _answer(self) -> dict:
        line = self.process.stdout.readline()
        if not line:
            code = self.process.wait()
            self.errors.seek(0)
            ending = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            raise Failed(reason(self.errors.read()) or ending)
        os.killpg(self.process.pid, signal.SIGSTOP)
        return json.loads(line)

    def close(self) -> None:
        for stop in (signal.SIGKILL, signal.SIGCONT):
            try:
                os.killpg(self.process.pid, stop)
            except ProcessLookupError:
                pass
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self.errors):
            try:
                stream.close()
            except BrokenPipeError:
                pass


def main() -> int:
    args = arguments()
    if args.list:
        print(*(case.name for case in CASES), sep="\n")
        return 0
    cases = args.cases or (QUICK if args.quick else CASES)
    # Compiling takes a minute; the rest of a smoke run takes seconds.
    peers = [peer for peer in peers_of(args.torch_device) if not args.quick or args.only or "compile" not in peer.name]
    peers = [peer for peer in peers if not args.only or any(word.lower() in peer.name.lower() for word in args.only)]
    print(machine(args), file=sys.stderr)
    # Stopped contenders would outlive this script.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    signal.signal(signal.SIGINT, lambda *_: sys.exit(1))
    comparisons, page = [], ""
    with tempfile.TemporaryDirectory() as folder:
        for case in cases:
            try:
                comparisons.append(compare(case, peers, args, Path(folder)))
            except Failed as error:
                print(f"error: {case.name}: {args.binary}: {error}", file=sys.stderr)
                return 1
            # Written after each case, because a run can take an hour.
            page = markdown(comparisons, args)
            for path in args.out:
                path.write_text(as_json(comparisons, args) if path.suffix == ".json" else page)
    print(page)
    # In a smoke run, a peer that disagrees or fails is an error; in a long run it is a note.
    return 1 if args.quick and any("was left out" in note for c in comparisons for note in c.notes) else 0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", metavar="NAME", type=Case.parse, help="names as in --list, with any size")
    parser.add_argument("--list", action="store_true", help="list the cases")
    parser.add_argument("--only", nargs="+", metavar="PEER", help="only peers whose names contain one of these words")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)), help="default: all cores")
    parser.add_argument("--quick", action="store_true", help="tiny cases without torch.compile; fail if a peer fails")
    parser.add_argument("--out", action="append", default=[], type=Path, metavar="FILE", help=".md or .json, repeatable")
    parser.add_argument("--device", default="flex", help="this project's device: flex, wgpu, cuda")
    parser.add_argument("--torch-device", default="cpu", help="PyTorch's device: cpu, cuda")
    parser.add_argument("--binary", type=Path, default=HERE.parents[1] / "target/release/peer")
    parser.add_argument("--arguments", default="", help="more arguments for this project's contender, in one string")
    parser.add_argument("--python", default=sys.executable, help="the peers' interpreter; default: this one")
    args = parser.parse_args()
    if not args.binary.exists():
        parser.error(f"{args.binary} is missing: cargo build --release -p demc-bench")
    return args


def compare(case: Case, peers: list[Peer], args: argparse.Namespace, folder: Path) -> Comparison:
    """Compares all peers in one case, each in turns with this project."""
    files = [f"--weights={folder / 'weights'}", f"--inputs={folder / 'inputs'}"]
    size = [str(x) for x in case.size]
    environment = os.environ | {name: str(args.threads) for name in ("RAYON_NUM_THREADS", "OMP_NUM_THREADS")}
    make = [str(args.binary), "make", "--width", str(case.width), "--size", *size, *files]
    subprocess.run(make, check=True, env=environment)
    rate = [f"--lr={LEARNING_RATE}"] if case.mode == "train" else []
    command = [str(args.binary), case.mode, *files, *rate, "--device", args.device, *shlex.split(args.arguments)]
    ours = Contender(command, environment)
    results, notes, own_ms = [], [], []
    onnx = folder / f"{case.name}.onnx"
    python = [args.python, str(HERE / "contender.py")]
    common = [*files, f"--threads={args.threads}", f"--onnx={onnx}", *(["--quick"] if args.quick else [])]
    try:
        truth = check(ours, case, folder / "ours")
        steps = turn(ours.ask("step 1")["seconds"], args)
        for peer in peers:
            if case.mode not in peer.modes:
                continue
            print(f"{case.name}: {peer.name}", file=sys.stderr)
            contender = None
            try:
                if peer.onnx and not onnx.exists():
                    export = [*python, "export", *common]
                    subprocess.run(export, check=True, capture_output=True, text=True, env=environment)
                contender = Contender([*python, case.mode, *common, *rate, *peer.arguments], environment)
                result = Result(peer.name, contender.about)
                result.deviation = deviation(truth, check(contender, case, folder / "theirs"))
                tolerance = TOLERANCES[peer.dtype][case.mode == "train"]
                if not result.deviation <= tolerance:
                    raise Failed(f"results differ: deviation {result.deviation:.1e}, allowed {tolerance:.0e}")
                choice = contender.ask("warm")["choice"]
                result.about += f", {choice}" if choice else ""
                their_steps = turn(contender.ask("step 1")["seconds"], args)
                for _ in range(args.rounds):
                    (ours_ms, others), (peer_ms, more) = ours.step(steps), contender.step(their_steps)
                    result.ours_ms.append(ours_ms)
                    result.peer_ms.append(peer_ms)
                    result.others += [others, more]
                result.peer_peak_mib = contender.ask("memory")["peak_mib"]
                results.append(result)
                if (others := statistics.median(result.others)) > QUIET:
                    notes.append(
                        f"{case.name}, {peer.name}: unreliable, other processes took {others:.0%} of the machine"
                        " (threads with spin waits, such as OpenMP's, are affected most)"
                    )
                own_ms += result.ours_ms
            except (Failed, subprocess.CalledProcessError) as error:
                said = reason(getattr(error, "stderr", None) or str(error))
                notes.append(f"{case.name}: {peer.name} was left out: {said}")
            finally:
                if contender:
                    contender.close()
        if not own_ms:
            own_ms = [ours.step(steps)[0] for _ in range(args.rounds)]
        peak = ours.ask("memory")["peak_mib"]
    finally:
        ours.close()
    return Comparison(case, ours.about, own_ms, peak, results, notes)


def processor_time(pid: int) -> tuple[int, int, int]:
    """Ticks so far: busy ticks of the machine, ticks of one process, and all ticks of the machine (Linux; else zeros)."""
    try:
        whole = [int(ticks) for ticks in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        own = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0, 0, 0
    idle = whole[3] + whole[4]
    return sum(whole) - idle, int(own[11]) + int(own[12]), sum(whole)


def turn(seconds: float, args: argparse.Namespace) -> int:
    """Number of steps in a turn."""
    return max(1, int((QUICK_TURN_SECONDS if args.quick else TURN_SECONDS) / seconds))


def reason(said: str) -> str:
    """The most informative line of a program's error output: an exception's name and message, or the last line."""
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    errors = [line for line in lines if re.match(r"([\w.]*[A-Z]\w+|error): ", line)]
    return (errors or lines or [""])[-1]


def check(contender: Contender, case: Case, path: Path) -> list[array]:
    """The results of a contender: an image, or losses and norms."""
    answer = contender.ask(f"check {path}")
    if case.mode == "train":
        return [array("d", [value]) for value in (*answer["losses"], *answer["grad_norms"])]
    if answer["zeros"] > 0.5:
        raise Failed(f"{answer['zeros']:.0%} of the output is zero, so equal outputs would prove nothing")
    return [read_output(path)]


def read_output(path: Path) -> array:
    """Reads the tensor `output` of a safetensors file without any package."""
    data = path.read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    entry = json.loads(data[8:start])["output"]
    assert entry["dtype"] == "F32" and sys.byteorder == "little"
    first, last = entry["data_offsets"]
    return array("f", data[start + first : start + last])


def deviation(ours: list[array], theirs: list[array]) -> float:
    """The largest difference of any quantity relative to its largest value; infinite for non-finite values."""
    worst = 0.0
    for a, b in zip(ours, theirs, strict=True):
        if len(a) != len(b):
            return math.inf
        share = max(abs(x - y) for x, y in zip(a, b)) / max(abs(x) for x in a)
        # Checks the sums, because `max` may ignore NaN.
        worst = max(worst, share) if math.isfinite(sum(a)) and math.isfinite(sum(b)) else math.inf
    return worst


if __name__ == "__main__":
    sys.exit(main())
