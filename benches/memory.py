#!/usr/bin/env python3
"""Measures whether the memory of long processes grows: python3 benches/memory.py [PROGRAMS]

One process trains 20,000 steps of a tiny network, another denoises 2,000 frames. The resident memory is
sampled until each ends. The growth compares the last quarter of the samples with the second quarter.
PROGRAMS is the directory of the programs (default: target/release).
"""
import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "data" / "sample"
STEPS, FRAMES = 20_000, 2_000
INTERVAL = 0.25  # Seconds between samples.
LIMIT = 0.01  # Largest accepted growth.

CONFIGURATION = f"""
[model]
width = 2
[data]
root = "{SAMPLE}"
batch_size = 1
patch_size = 32
[train]
steps = {STEPS}
[run]
log_every = 1000
validate_every = {STEPS}
checkpoint_every = {STEPS}
"""


def resident(pid):
    """Resident memory of a process in KiB; None after its end."""
    try:
        status = pathlib.Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return None
    return next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS:")), None)


def measure(name, command, meanwhile=lambda: None):
    """Runs a command and prints its memory. Returns the growth."""
    started = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    samples = []
    while process.poll() is None:
        samples.append(resident(process.pid))
        meanwhile()
        time.sleep(INTERVAL)
    if process.returncode:
        sys.exit(f"{name}: {process.stderr.read().decode()}")
    samples = [sample for sample in samples if sample]
    quarter = len(samples) // 4
    early, late = (statistics.median(part) for part in (samples[quarter:2 * quarter], samples[-quarter:]))
    growth = late / early - 1
    print(f"{name}: {early / 1024:.1f} MiB in the second quarter, {late / 1024:.1f} MiB in the last, "
          f"{100 * growth:+.2f} %, {time.monotonic() - started:.0f} s", flush=True)
    return growth


def main():
    programs = pathlib.Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "target" / "release"
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        (folder / "tiny.toml").write_text(CONFIGURATION)
        training = measure(f"{STEPS} training steps", [programs / "demc-train", "--config", folder / "tiny.toml",
                                                      "--run-dir", folder / "run"])
        frames, out = folder / "frames", folder / "out"
        frames.mkdir()
        out.mkdir()
        frame = next((SAMPLE / "test").glob("*.exr"))
        for number in range(FRAMES):
            os.symlink(frame, frames / f"f{number:04}.exr")

        def tidy():
            for path in out.glob("f*.exr"):
                path.unlink(missing_ok=True)

        model = folder / "model.safetensors"
        subprocess.run([programs / "demc-infer", "export", "--model", folder / "run", "-o", model], check=True,
                       stdout=subprocess.DEVNULL)
        denoising = measure(f"{FRAMES} frames", [programs / "demc-infer", "denoise", "--model", model, frames, "-o", out],
                            tidy)
        shutil.rmtree(frames)
    return int(max(training, denoising) > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
