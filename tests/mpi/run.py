#!/usr/bin/env python3
"""Tests training on MPI ranks: python3 tests/mpi/run.py [--program demc-train] [--kills 20] [NAME...]

The program is a build with `--features mpi`. Needed: mpirun of Open MPI. As root, rank 1 also gets other data with
`unshare`; elsewhere these tests are skipped. A NAME selects tests that contain it. Nothing outside a temporary
directory is written.
"""
import argparse
import json
import os
import pathlib
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import unittest

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
SAMPLE = REPOSITORY / "data" / "sample"
LIMIT = 30  # Seconds in which a job ends after a fault.
TIMES = {"patches_per_s", "elapsed_s"}  # Keys of metrics.jsonl that depend on the computer.
TINY = """
[model]
width = 4
[data]
root = "data"
patch_size = 32
stride = 32
batch_size = 2
validation = 0.2
[train]
steps = 8
grad_accumulation = 4
[run]
log_every = 2
validate_every = 4
checkpoint_every = 2
keep = 9
"""
RECIPES = {
    "paper": [],
    "released": ["model.reading=released"],
    "muon": ["optimizer.kind=muon", "train.ema_decay=0.9", "optimizer.max_grad_norm=0.1",
             "data.augment=[\"flip\",\"transpose\"]"],
    "shares that are no blocks": ["train.grad_accumulation=6"],
}
OPTIONS = argparse.Namespace()


class Job:
    """mpirun, its ranks, and what they print."""

    def __init__(self, folder, ranks, *arguments, wrapper=None, environment=None):
        command = ["mpirun", "--oversubscribe", "-n", str(ranks)]
        command += ["sh", "-c", wrapper, OPTIONS.program] if wrapper else [OPTIONS.program]
        environment = {**os.environ, "OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
                       **(environment or {})}
        self.process = subprocess.Popen([*command, *arguments], cwd=folder, env=environment, text=True,
                                        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def ranks(self):
        """The process ids of the ranks that run."""
        children = pathlib.Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        programs = {child: pathlib.Path(f"/proc/{child}/exe") for child in children}
        return [int(child) for child, exe in programs.items() if exe.exists() and "demc" in os.readlink(exe)]

    def end(self, seconds=LIMIT):
        try:
            self.stdout, self.stderr = self.process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        self.code = self.process.returncode
        return self

    def __repr__(self):
        return f"exit code {self.code}\n--- stdout\n{self.stdout[-3000:]}\n--- stderr\n{self.stderr[-3000:]}"


class Ranks(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory(prefix="demc-mpi-")
        self.addCleanup(temporary.cleanup)
        self.folder = pathlib.Path(temporary.name)
        shutil.copytree(SAMPLE, self.folder / "data")
        (self.folder / "tiny.toml").write_text(TINY)

    def start(self, ranks, run, *sets, resume=False, **options):
        sets = [argument for text in sets for argument in ("--set", text)]
        return Job(self.folder, ranks, "--config", "tiny.toml", "--run-dir", run, *sets,
                   *(["--resume"] if resume else []), **options)

    def train(self, ranks, run, *sets, **options):
        job = self.start(ranks, run, *sets, **options).end(300)
        self.assertEqual(job.code, 0, job)
        return job

    def result(self, run):
        """The bytes of all weights and optimizer states, and the log without times."""
        folder = self.folder / run
        files = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.safetensors")}
        self.assertTrue(any("optimizer" in name for name in files), files.keys())
        lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        files["metrics.jsonl"] = [{key: line[key] for key in line if key not in TIMES} for line in lines]
        for name in ("test.json", "strips/test.png"):
            files[name] = (folder / name).read_bytes()
        return files

    def assert_same(self, found, expected):
        different = [name for name in expected.keys() | found.keys() if found.get(name) != expected.get(name)]
        self.assertEqual(different, [])

    def assert_ends(self, job, *words, run=None):
        """The job fails in time, and one line names the cause."""
        job.end()
        self.assertNotEqual(job.code, 0, job)
        lines = [line for line in job.stderr.splitlines() if line.startswith("error: ")]
        self.assertEqual(len(lines), 1, job)
        for word in words:
            self.assertIn(word, lines[0])
        if run:
            self.assertFalse((self.folder / run).exists(), job)

    # The same bytes

    def test_ranks_do_not_change_the_bits(self):
        for recipe, sets in RECIPES.items():
            self.train(1, f"{recipe}-1", *sets)
            expected = self.result(f"{recipe}-1")
            for ranks in (2, 3) if "train.grad_accumulation=6" in sets else (2, 4):
                with self.subTest(recipe=recipe, ranks=ranks):
                    self.train(ranks, f"{recipe}-{ranks}", *sets)
                    self.assert_same(self.result(f"{recipe}-{ranks}"), expected)

    def test_shared_memory_and_tcp(self):
        for transport in ("vader,self", "tcp,self"):
            self.train(2, transport, environment={"OMPI_MCA_btl": transport})
        self.assert_same(self.result("tcp,self"), self.result("vader,self"))

    def test_a_run_resumes_on_another_number_of_ranks(self):
        sets = RECIPES["released"]
        self.train(1, "whole", *sets)
        for first, second in ((4, 1), (1, 2), (2, 4)):
            run = f"{first}-{second}"
            with self.subTest(run):
                self.train(first, run, *sets)
                for step in (8, 6):
                    shutil.rmtree(self.folder / run / "checkpoints" / f"step-{step:08}")
                (self.folder / run / "latest").write_text("step-00000004")
                self.train(second, run, *sets, resume=True)
                self.assert_same(self.result(run), self.result("whole"))

    def test_skipped_steps(self):
        """Such a weight makes every loss infinite on every rank."""
        for ranks in (1, 2):
            job = self.start(ranks, f"skip{ranks}", "loss.relmse=3e38", "train.on_nan=skip").end(60)
            self.assertEqual(job.code, 1, job)
            self.assertIn("all 8 steps were skipped", job.stderr)
        logs = [(self.folder / f"skip{ranks}" / "metrics.jsonl").read_text() for ranks in (1, 2)]
        self.assertEqual(*[re.sub(r'"(patches_per_s|elapsed_s)":[^,}]*', "", log) for log in logs])

    def test_find_lr(self):
        for ranks in (1, 2):
            job = Job(self.folder, ranks, "find-lr", "--config", "tiny.toml", "--steps", "10", "-o", f"lr{ranks}")
            self.assertEqual(job.end(60).code, 0, job)
        self.assertEqual(*[(self.folder / f"lr{ranks}.csv").read_text() for ranks in (1, 2)])

    def test_ablate(self):
        """Two variants with two seeds: 4 ranks train four runs at once, 8 ranks train each on two."""
        variant = '[[variants]]\nname = "{}"\nset = ["model.variant={}"]\n'
        (self.folder / "ablation.toml").write_text(
            'base = "tiny.toml"\ndir = "ablation"\nseeds = [1, 2]\n' + variant.format("a", "demc") + variant.format("b", "semc"))
        for ranks in (1, 4, 8):
            job = Job(self.folder, ranks, "ablate", "--config", "ablation.toml", "--run-dir", f"ablation-{ranks}").end(300)
            self.assertEqual(job.code, 0, job)
            self.assertEqual(job.stdout.count("== "), 4, job)
        tables = [json.loads((self.folder / f"ablation-{ranks}" / "ablation.json").read_text()) for ranks in (1, 4, 8)]
        scores = [re.findall(r'"relmse": [^,]*', json.dumps(table)) for table in tables]
        self.assertTrue(scores[0])
        self.assertEqual(scores[1:], [scores[0]] * 2)

    # What is printed

    def test_one_rank_prints(self):
        job = self.train(2, "run")
        self.assertEqual(job.stdout.count("demc-train: about"), 1, job)
        self.assertRegex(job.stdout, r"2 ranks on 1 node\(s\) \(.+\), threads per rank: \d+, device: flex, each sends")
        self.assertRegex(job.stdout, r"step +8 .*exchange [\d.]+ %")

    def test_the_number_of_ranks_divides_the_batches(self):
        job = self.start(3, "run")
        self.assert_ends(job, "3 ranks", "train.grad_accumulation = 4", "1, 2, 4 ranks", run="run")
        self.assertEqual(job.code, 2)

    # Faults

    def other(self, rank_1):
        """Runs `rank_1` as rank 1, and the program itself as the others."""
        return f'if [ "$OMPI_COMM_WORLD_RANK" = 1 ]; then {rank_1}; else exec "$0" "$@"; fi'

    def test_another_configuration(self):
        job = self.start(2, "run", wrapper=self.other('exec "$0" "$@" --set optimizer.lr_start=2e-4'))
        self.assert_ends(job, "the configuration of rank 1 on ", "lr_start = 0.0002 instead of lr_start = 0.0001",
                         run="run")

    def test_a_wrong_configuration(self):
        job = self.start(2, "run", wrapper=self.other('exec "$0" "$@" --set optimizer.lr_start=-1.0'))
        self.assert_ends(job, "rank 1 on ", "optimizer.lr_start = -1.0", run="run")

    def test_another_program(self):
        shutil.copy(OPTIONS.program, self.folder / "other-demc-train")
        with open(self.folder / "other-demc-train", "ab") as file:
            file.write(b"\0")
        job = self.start(2, "run", wrapper=self.other('exec ./other-demc-train "$@"'))
        self.assert_ends(job, "the program of rank 1 on ", "SHA-256", run="run")

    def hidden(self, change):
        """Runs rank 1 in a mount namespace in which `change` was done to a copy of the data."""
        if subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode:
            self.skipTest("no mount namespaces")
        shutil.copytree(self.folder / "data", self.folder / "theirs")
        change(self.folder / "theirs")
        return self.other('exec unshare -m sh -c \'mount --bind theirs data && exec "$0" "$@"\' "$0" "$@"')

    def test_missing_scenes(self):
        """The ranks of a node share the check, so rank 1 finds one of them."""
        wrapper = self.hidden(lambda data: [file.unlink() for file in (data / "train").iterdir()])
        self.assert_ends(self.start(2, "run", wrapper=wrapper), "rank 1 on ", "scene ", "No such file", run="run")

    def test_other_scenes(self):
        other = SAMPLE / "test" / "gen-table-test-1.exr"
        wrapper = self.hidden(lambda data: [shutil.copy(other, file) for file in (data / "train").iterdir()])
        self.assert_ends(self.start(2, "run", wrapper=wrapper), "rank 1 on ", "scene ",
                         "differs from the file of rank 0", run="run")

    def test_a_scene_that_goes_missing(self):
        """The cache holds nothing, so that a rank reads each scene again.

        The message names a rank if one found it in its step, but not if all did in a validation.
        """
        job = self.start(2, "run", "data.cache_mib=0", "train.steps=1000000")
        self.wait_for("run/checkpoints/step-00000002", job)
        shutil.rmtree(self.folder / "data" / "train")
        self.assert_ends(job, "/data/train/", "No such file")

    def test_a_full_disk(self):
        self.train(1, "whole")
        wrapper = 'trap "" XFSZ; if [ "$OMPI_COMM_WORLD_RANK" = 0 ]; then ulimit -f 400; fi; exec "$0" "$@"'
        self.assert_ends(self.start(2, "run", wrapper=wrapper), "rank 0 on ", "File too large")
        self.train(2, "run", resume=True)
        self.assert_same(self.result("run"), self.result("whole"))

    def wait_for(self, name, job):
        path, start = self.folder / name, time.monotonic()
        while not path.exists() and job.process.poll() is None and time.monotonic() - start < 60:
            time.sleep(0.01)
        self.assertTrue(path.exists(), job.end() if job.process.poll() is not None else "it takes too long")

    def test_sigterm_to_one_rank(self):
        self.train(1, "whole", "train.steps=400")
        job = self.start(2, "run", "train.steps=400")
        self.wait_for("run/checkpoints/step-00000002", job)
        os.kill(job.ranks()[1], signal.SIGTERM)
        job.end()
        self.assertEqual(job.code, 128 + signal.SIGTERM, job)
        self.assertRegex(job.stdout, r"SIGTERM: stopped after step \d+, everything is saved")
        self.train(2, "run", "train.steps=400", resume=True)
        self.assertEqual(self.last("run"), self.last("whole"))

    def last(self, run):
        return (self.folder / run / "checkpoints" / "step-00000400" / "model.safetensors").read_bytes()

    def test_killed_ranks(self):
        """SIGKILL of a random rank at a random moment, from the start of the program on."""
        sets = ("train.steps=400", "run.checkpoint_every=50", "run.validate_every=100")
        start = time.monotonic()
        self.train(2, "whole", *sets)
        seconds, chance, kills = time.monotonic() - start, random.Random(OPTIONS.seed), 0
        while kills < OPTIONS.kills:
            job = self.start(2, "run", *sets, resume=True)
            time.sleep(chance.uniform(0, seconds))
            ranks = job.ranks() if job.process.poll() is None else []
            if ranks:
                os.kill(chance.choice(ranks), signal.SIGKILL)
            job.end()
            kills += bool(ranks)
            if ranks and job.code:
                self.assertIn("exited on signal 9", job.stderr, job)
            elif not job.code:
                self.assertEqual(self.last("run"), self.last("whole"))
                shutil.rmtree(self.folder / "run")
        self.train(1, "run", *sets, resume=True)
        self.assertEqual(self.last("run"), self.last("whole"))
        print(f"{kills} ranks killed, seed {OPTIONS.seed}", file=sys.stderr)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default=REPOSITORY / "target" / "mpi" / "demc-train", type=pathlib.Path,
                        help="demc-train, built with --features mpi (default: target/mpi/demc-train)")
    parser.add_argument("--kills", type=int, default=20, metavar="N", help="number of killed ranks (default: 20)")
    parser.add_argument("--seed", type=int, default=None, help="seed of the moments (default: random)")
    parser.add_argument("names", nargs="*", metavar="NAME", help="run only tests whose name contains NAME")
    parser.parse_args(namespace=OPTIONS)
    OPTIONS.program = str(OPTIONS.program.resolve())
    OPTIONS.seed = random.SystemRandom().randrange(1 << 32) if OPTIONS.seed is None else OPTIONS.seed
    loader = unittest.TestLoader()
    loader.testNamePatterns = [f"*{name}*" for name in OPTIONS.names] or None
    outcome = unittest.TextTestRunner(verbosity=2).run(loader.loadTestsFromTestCase(Ranks))
    return 0 if outcome.wasSuccessful() and outcome.testsRun else 1


if __name__ == "__main__":
    sys.exit(main())
