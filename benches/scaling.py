#!/usr/bin/env python3
"""Measures training on MPI ranks of this computer: python3 benches/scaling.py [--program FILE] [--rounds 5]

The program is a build of demc-train with `--features mpi`. It writes a Markdown table of steps per second on 1, 2, and
4 ranks of one thread (strong: the same 4 micro-batches; weak: one micro-batch per rank), the time of the exchange for
networks of several widths, and the latency and bandwidth that fit it. Cases run in turns; numbers are medians, with
quartiles in brackets.
"""
import argparse
import json
import os
import pathlib
import re
import statistics
import subprocess
import tempfile

REPOSITORY = pathlib.Path(__file__).resolve().parent.parent
STEPS = 6  # The first one warms up.
WIDTHS = (8, 16, 32, 64)  # Networks of the exchange measurement.


def train(program, ranks, threads, width, batches, batch_size, patch_size):
    """Seconds per step, seconds of exchange per step, and megabytes that a rank sends per step."""
    with tempfile.TemporaryDirectory(prefix="demc-scaling-") as folder:
        sets = {"model.width": width, "data.root": f'"{REPOSITORY / "data" / "sample"}"', "data.batch_size": batch_size,
                "data.patch_size": patch_size, "data.stride": patch_size, "data.validation": 0.0, "train.steps": STEPS,
                "train.grad_accumulation": batches, "run.log_every": 1}
        command = [program, "--config", REPOSITORY / "configs" / "demc.toml", "--run-dir", f"{folder}/run"]
        command += [part for key, value in sets.items() for part in ("--set", f"{key}={value}")]
        if ranks > 1:
            command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), *command]
        environment = {**os.environ, "RAYON_NUM_THREADS": str(threads), "OMPI_ALLOW_RUN_AS_ROOT": "1",
                       "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        lines = [json.loads(line) for line in (pathlib.Path(folder) / "run" / "metrics.jsonl").read_text().splitlines()]
    patches = batches * batch_size
    step = statistics.median(patches / line["patches_per_s"] for line in lines[1:])
    shares = [float(share) for share in re.findall(r"exchange ([\d.]+) %", done.stdout)][1:]
    sent = re.search(r"each sends ([\d.]+) MB", done.stdout)
    exchange = step * statistics.median(shares) / 100 if shares else 0.0
    return step, exchange, float(sent[1]) if sent else 0.0


def shown(values, digits=2):
    low, middle, high = statistics.quantiles(values, n=4) if len(values) > 1 else values * 3
    return f"{middle:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"


def line(points):
    """Least squares of y = a + b x."""
    x, y = zip(*points)
    slope, start = statistics.linear_regression(x, y)
    return start, slope


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default=REPOSITORY / "target" / "mpi" / "demc-train", type=pathlib.Path,
                        help="demc-train, built with --features mpi (default: target/mpi/demc-train)")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="rounds (default: 5)")
    parser.add_argument("--width", type=int, default=32, metavar="C", help="width of the network (default: 32)")
    arguments = parser.parse_args()
    program = arguments.program.resolve()
    # Ranks, threads per rank, micro-batches.
    work = {"strong": [(1, 1, 4), (1, 2, 4), (2, 1, 4), (4, 1, 4)], "weak": [(1, 1, 1), (2, 1, 2), (4, 1, 4)]}
    cases = sorted({case for group in work.values() for case in group})
    times = {case: [] for case in cases}
    exchanges = {width: [] for width in WIDTHS}
    for _ in range(arguments.rounds):
        for case in cases:
            ranks, threads, batches = case
            times[case].append(train(program, ranks, threads, arguments.width, batches, 4, 128))
        for width in WIDTHS:
            exchanges[width].append(train(program, 2, 1, width, 2, 1, 32))
    print("| work | ranks | threads per rank | micro-batches | s per step | steps per s | exchange, ms |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, group in work.items():
        for case in group:
            steps = [step for step, _, _ in times[case]]
            exchange = [1000 * exchange for _, exchange, _ in times[case]]
            rate = 1 / statistics.median(steps)
            print(f"| {name} | {case[0]} | {case[1]} | {case[2]} | {shown(steps)} | {rate:.2f} | {shown(exchange, 0)} |")
    ratios = [ranks[0] / threads[0] for ranks, threads in zip(times[2, 1, 4], times[1, 2, 4])]
    print(f"\n2 ranks of one thread take {shown(ratios)} times as long as 1 process with two threads.")
    print("\n| width | each rank sends, MB | exchange, ms |\n|---:|---:|---:|")
    points = []
    for width, found in exchanges.items():
        sent, milliseconds = found[0][2], [1000 * exchange for _, exchange, _ in found]
        points.append((sent, statistics.median(milliseconds)))
        print(f"| {width} | {sent:.1f} | {shown(milliseconds)} |")
    latency, slope = line(points)
    print(f"\nFit: {latency:.2f} ms per exchange and {1 / slope:.2f} GB/s.")


if __name__ == "__main__":
    main()
