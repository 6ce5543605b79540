#!/usr/bin/env python3
"""Kills writers at random moments: python3 tests/attack/kills.py [--count 1000] [--seed N]

Writers are training with checkpoints, denoise, report, `demc-data index`, and `demc-data merge`. After each SIGKILL
an output is absent or complete. A second, undisturbed command gives the bytes of a run that was never killed, and
removes what the killed one left. The last line gives the number of kills per writer.
"""
import argparse
import collections
import json
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import common
import outputs

# Files that differ between two runs of the same training, because they contain times or their checksums.
VARYING = {"metrics.jsonl", "lock", "state.json", "SHA256SUMS"}
MAX_PROBLEMS = 20
TRAIN = ["demc-train", "--config", "tiny.toml", "--run-dir", "kill", "--set", "train.steps=4",
         "--set", "run.checkpoint_every=1", "--set", "run.validate_every=2"]
MODEL = ["--model", "model.safetensors"]


class Writer:
    """A command, the command that finishes its work after a kill, and its outputs (files or directories).

    weight: how often it is killed.
    """

    def __init__(self, name, weight, command, made, again=()):
        self.name, self.weight, self.command, self.made = name, weight, command, made
        self.again = [*command, *again]


WRITERS = [
    Writer("train", 1, TRAIN, ["kill"], ["--resume"]),
    Writer("denoise", 3, ["demc-infer", "denoise", "many", "-o", "kill", "--png", *MODEL], ["kill"]),
    Writer("report", 2, ["demc-infer", "report", "--data", "data", "-o", "kill.html", *MODEL], ["kill.html"],
           ["--overwrite"]),
    Writer("index", 3, ["demc-data", "index", "many"], ["many/manifest.json"], ["--overwrite"]),
    Writer("merge", 4, ["demc-data", "merge", "x=frame.exr", "bare/scene.exr", "-o", "kill.exr"], ["kill.exr"],
           ["--overwrite"]),
]


def written(project, writer):
    """The bytes of each output; None for a file that differs from run to run."""
    found = {}
    for made in writer.made:
        place = project / made
        for file in sorted(place.rglob("*")) if place.is_dir() else [place] if place.exists() else []:
            if file.is_file() and "tensorboard" not in file.parts:
                varying = file.name in VARYING
                found[str(file.relative_to(project))] = None if varying else file.read_bytes()
    return found


def clean(project, writer):
    for made in writer.made:
        place = project / made
        if place.is_dir():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        for left in place.parent.glob(".*.tmp"):
            left.unlink()


def start(project, command):
    return subprocess.Popen([common.PROGRAMS / command[0], *command[1:]], cwd=project, stdin=subprocess.DEVNULL,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def finish(process):
    _, stderr = process.communicate(timeout=300)
    assert process.returncode == 0, f"exit code {process.returncode}: {stderr.decode(errors='replace')[-2000:]}"


def problem(project, writer, expected, after):
    """Kills the writer after so many seconds. Returns whether it was killed, and what is wrong."""
    process = start(project, writer.command)
    try:
        process.wait(timeout=after)
    except subprocess.TimeoutExpired:
        pass
    process.send_signal(signal.SIGKILL)
    process.communicate()
    killed = process.returncode == -signal.SIGKILL
    for name, found in written(project, writer).items():
        path = pathlib.Path(name)
        in_progress = path.name.endswith(".tmp") or any(part.endswith(".tmp") for part in path.parts)
        # A run's weights and checkpoints change from step to step; resuming checks them.
        if found is None or in_progress or writer.name == "train":
            continue
        if found != expected.get(name):
            return killed, f"{name} is incomplete after a kill at {after:.3f} s"
    if not killed and process.returncode:
        return killed, f"exit code {process.returncode}"
    finish(start(project, writer.again))
    found = written(project, writer)
    if found != expected:
        different = [name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name)]
        return killed, f"after a kill at {after:.3f} s and a second run these differ: {', '.join(sorted(different))}"
    left = [str(path) for path in project.rglob(".*.tmp")]
    return killed, f"left after a kill at {after:.3f} s: {', '.join(left)}" if left else None


def prepared():
    """A project with what the writers read."""
    temporary = tempfile.TemporaryDirectory(prefix="demc-kills-")
    project = pathlib.Path(temporary.name) / "project"
    shutil.copytree(common.template(), project)
    outputs.prepare(project)
    (project / "many").mkdir()
    for number in range(4):
        shutil.copy(project / "frame.exr", project / "many" / f"room{number}-1.exr")
    return temporary, project


def attack(count, seed):
    """Kills `count` writers. Returns the number of kills per writer and all problems."""
    temporary, project = prepared()
    chance = random.Random(seed)
    kills, problems = collections.Counter(), []
    with temporary:
        known = {}
        while sum(kills.values()) < count and len(problems) < MAX_PROBLEMS:
            writer = chance.choices(WRITERS, [writer.weight for writer in WRITERS])[0]
            clean(project, writer)
            if writer.name not in known:
                begin = time.monotonic()
                finish(start(project, writer.command))
                known[writer.name] = written(project, writer), time.monotonic() - begin
                clean(project, writer)
            expected, seconds = known[writer.name]
            after = chance.uniform(0, seconds)
            killed, wrong = problem(project, writer, expected, after)
            kills[writer.name] += killed
            if not killed:  # The computer is faster than it was.
                known[writer.name] = expected, after
            if wrong:
                problems.append(f"{writer.name}: {wrong}")
                print(problems[-1], file=sys.stderr)
    return kills, problems


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=40, help="number of kills (default: 40)")
    parser.add_argument("--seed", type=int, default=None, help="seed of the moments (default: random)")
    arguments = parser.parse_args()
    seed = random.SystemRandom().randrange(1 << 32) if arguments.seed is None else arguments.seed
    kills, problems = attack(arguments.count, seed)
    print(json.dumps({"seed": seed, "kills": kills, "all": sum(kills.values()), "problems": len(problems)}))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
