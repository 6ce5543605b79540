"""Tests of `demc.train`, `demc.evaluate`, layers, and the programs of the wheel; see `test_native.py`."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import unittest
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from test_native import IS_SKIPPED, MISSING, ROOT, SAMPLE, Interruption, program

if not IS_SKIPPED:
    import demc
    import numpy as np

CONFIG = ROOT / "configs" / "quickstart.toml"
OVERRIDES = {"train.steps": 6, "run.validate_every": 3, "run.checkpoint_every": 3, "data.root": SAMPLE, "data.batch_size": 1}
"""A run of some seconds."""
SCRIPT = """
import demc, signal, sys
# A shell's background jobs ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
def on_step(taken):
    print(taken.step, flush=True)
try:
    demc.train(sys.argv[1], overrides={"train.steps": 500, "data.root": sys.argv[2]}, run_dir=sys.argv[3], on_step=on_step)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""
"""Trains until Ctrl-C."""
PROGRAM = "from demc.programs import {}; {}()"


@unittest.skipIf(IS_SKIPPED, f"no {', '.join(MISSING)}")
class Runs(unittest.TestCase):
    def setUp(self) -> None:
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.folder = Path(directory.name)

    def train(self, name: str = "run", **options):
        options["overrides"] = OVERRIDES | options.get("overrides", {})
        return demc.train(CONFIG, run_dir=self.folder / name, **options)

    def bytes_of(self, name: str) -> bytes:
        return (self.folder / name / "best.safetensors").read_bytes()


class Training(Runs):
    def test_weights_are_those_of_the_command_line(self) -> None:
        steps = []
        result = self.train(on_step=steps.append)
        sets = [f"--set={key}={value}" for key, value in OVERRIDES.items()]
        command = [program("demc-train"), "--config", CONFIG, "--run-dir", self.folder / "other", *sets]
        done = subprocess.run(command, capture_output=True, text=True)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertEqual(self.bytes_of("run"), self.bytes_of("other"))
        self.assertEqual([(taken.step, taken.steps) for taken in steps], [(i, 6) for i in range(1, 7)])
        self.assertEqual([taken.step for taken in steps if taken.valid_relmse is not None], [3, 6])
        self.assertEqual(result.run_dir, self.folder / "run")
        self.assertEqual(result.scores, json.loads((self.folder / "other" / "test.json").read_text()))
        self.assertIn(f"step {result.step}", result.kept)
        self.assertEqual(demc.Model.load(result.run_dir).step, result.step)

    def test_an_exception_saves_the_run_and_a_resumed_one_has_the_same_bytes(self) -> None:
        self.train("whole")

        def stop(taken) -> None:
            if taken.step == 4:
                raise Interruption

        with self.assertRaises(Interruption):
            self.train(on_step=stop)
        steps = []
        result = self.train(resume=True, on_step=lambda taken: steps.append(taken.step))
        self.assertEqual(steps, [5, 6])
        self.assertTrue(any("resuming from" in note for note in result.notes), result.notes)
        self.assertEqual(self.bytes_of("run"), self.bytes_of("whole"))

    def test_ctrl_c_saves_the_run_and_stops(self) -> None:
        command = [sys.executable, "-c", SCRIPT, CONFIG, SAMPLE, self.folder / "run"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            self.assertEqual(process.stdout.readline(), "1\n")
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=120)
        lines = output.split()
        self.assertEqual((lines[-1], process.returncode, errors), ("interrupted", 0, ""))
        last = int((["1"] + lines[:-1])[-1])
        self.assertLess(last, 500)
        run = self.folder / "run"
        checkpoint = run / "checkpoints" / (run / "latest").read_text().strip()
        # The step that the signal interrupted is not reported.
        self.assertIn(demc.Model.load(checkpoint).step, (last, last + 1))

    def test_a_callback_may_denoise(self) -> None:
        shapes = []
        color = np.full((32, 48, 3), 0.5, np.float32)
        preview = lambda taken: shapes.append(demc.denoise(color, normal=color, albedo=color).shape)
        with warnings.catch_warnings(action="ignore"):
            self.train(overrides={"train.steps": 2}, on_step=preview)
        self.assertEqual(shapes, [color.shape] * 2)

    def test_quiet_runs_print_nothing(self) -> None:
        for quiet in (True, False):
            script = f"import demc; demc.train({str(CONFIG)!r}, overrides={{'train.steps': 1, 'data.root': {str(SAMPLE)!r}}}, run_dir={str(self.folder / str(quiet))!r}, quiet={quiet})"
            done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
            self.assertEqual((done.returncode, done.stderr), (0, ""))
            self.assertEqual(done.stdout == "", quiet)

    def test_mistakes(self) -> None:
        with self.assertRaisesRegex(demc.DemcError, "train.steps"):
            self.train(overrides={"train.steps": -1})
        with self.assertRaisesRegex(demc.DemcError, "unknown .*stepz"):
            self.train(overrides={"train.stepz": 1})
        with self.assertRaisesRegex(TypeError, r"\{\} is dict: expected a number"):
            self.train(overrides={"train.steps": {}})
        with self.assertRaisesRegex(FileNotFoundError, "none.toml"):
            demc.train(self.folder / "none.toml")
        self.train(overrides={"train.steps": 1})
        with self.assertRaisesRegex(demc.DemcError, "run"):
            self.train(overrides={"train.steps": 1})


class Layers(Runs):
    def test_layers_of_a_kernel_head_add_up_to_the_colour(self) -> None:
        self.train(overrides={"model.head": "kernel", "train.steps": 1, "data.restore_light": False})
        model = demc.Model.load(self.folder / "run")
        self.assertTrue(model.takes_layers)
        rng = np.random.default_rng(1)
        key, fill = rng.random((2, 40, 33, 3), np.float32)
        guides = {"normal": np.full_like(key, 0.577), "albedo": rng.random(key.shape, np.float32)}
        layers = {"key": key.astype(np.float16), "fill": fill.transpose(2, 0, 1), "A": key[..., 0]}
        total = layers["key"].astype(np.float32) + fill
        with warnings.catch_warnings(action="ignore"):
            found = model.denoise(total, layers=layers, **guides)
            planes = model.denoise(total, layers={f"fill.{end}": fill[..., i] for i, end in enumerate("RGB")}, **guides)
        self.assertEqual(found.alpha, None)
        for name, layer in layers.items():
            self.assertEqual((found.layers[name].shape, found.layers[name].dtype), (layer.shape, layer.dtype))
        together = found.layers["key"].astype(np.float32) + found.layers["fill"].transpose(1, 2, 0)
        np.testing.assert_allclose(together, found.color, rtol=1e-2, atol=1e-3)
        for i, end in enumerate("RGB"):
            self.assertEqual(found.layers["fill"][i].tobytes(), planes.layers[f"fill.{end}"].tobytes())


    def test_layers_of_a_network_without_kernels_add_up_to_the_colour(self) -> None:
        self.train(overrides={"model.head": "grey", "train.steps": 1})
        model = demc.Model.load(self.folder / "run")
        self.assertTrue(model.takes_layers)
        key, fill = np.random.default_rng(1).random((2, 3, 40, 33), np.float32)
        guides = {"normal": np.full_like(key, 0.577), "albedo": fill}
        shares = []
        with warnings.catch_warnings(action="ignore"):
            found = model.denoise(
                key + fill, layers={"key": key, "fill": fill}, passes=4, on_progress=shares.append, **guides
            )
        np.testing.assert_allclose(found.layers["key"] + found.layers["fill"], found.color, rtol=1e-3, atol=1e-4)
        self.assertEqual(shares, sorted(shares))


class Evaluation(Runs):
    def test_scores_are_those_of_the_command_line(self) -> None:
        seen = []
        report = demc.evaluate(SAMPLE, on_scene=seen.append)
        command = [program("demc-infer"), "evaluate", "--data", SAMPLE, "--json", "-"]
        done = subprocess.run(command, capture_output=True, text=True)
        expected = json.loads(done.stdout)
        self.assertEqual(report, {key: expected[key] for key in ("images", "mean")})
        self.assertEqual(seen, report["images"])

    def test_an_exception_stops_the_work(self) -> None:
        def stop(_scores: dict) -> None:
            raise Interruption

        with self.assertRaises(Interruption):
            demc.evaluate(SAMPLE, on_scene=stop)

    def test_mistakes(self) -> None:
        with self.assertRaisesRegex(demc.DemcError, "split must be train or test"):
            demc.evaluate(SAMPLE, split="all")
        with self.assertRaisesRegex(FileNotFoundError, "manifest.json"):
            demc.evaluate(self.folder)
        with self.assertRaisesRegex(demc.DemcError, "none"):
            demc.evaluate(SAMPLE, layout="none")


class Programs(Runs):
    def run_program(self, function: str, *arguments: object) -> subprocess.CompletedProcess:
        command = [sys.executable, "-c", PROGRAM.format(function, function), *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True)

    def test_help_and_version(self) -> None:
        for function in ("infer", "data", "train"):
            with self.subTest(function):
                done = self.run_program(function, "--help")
                self.assertEqual(done.returncode, 0, done.stderr)
                self.assertIn("Usage:", done.stdout)
                done = self.run_program(function, "--version")
                self.assertEqual(done.stdout, f"demc-{function} {demc.__version__}\n")

    def test_exit_codes(self) -> None:
        for function in ("infer", "data", "train"):
            self.assertEqual(self.run_program(function, "--no-such-flag").returncode, 2)
        self.assertEqual(self.run_program("infer", "inspect", "--model", self.folder / "none").returncode, 1)

    def test_images_are_those_of_the_built_program(self) -> None:
        source = SAMPLE / "test" / "gen-table-test-1.exr"
        ours, theirs = self.folder / "ours.exr", self.folder / "theirs.exr"
        self.assertEqual(self.run_program("infer", "denoise", source, "-o", ours).returncode, 0)
        command = [program("demc-infer"), "denoise", source, "-o", theirs]
        subprocess.run(command, check=True, capture_output=True)
        self.assertEqual(ours.read_bytes(), theirs.read_bytes())

    def test_denoise_exr_writes_what_the_built_program_writes(self) -> None:
        source = SAMPLE / "test" / "gen-table-test-1.exr"
        ours, theirs = self.folder / "ours-2.exr", self.folder / "theirs-2.exr"
        demc.denoise_exr(source, ours, model=ROOT / "models" / "quality.safetensors")
        subprocess.run([program("demc-infer"), "denoise", source, "-o", theirs], check=True, capture_output=True)
        self.assertEqual(ours.read_bytes(), theirs.read_bytes())
        demc.denoise_exr(source, ours)  # It is finished.
        for error, text, arguments in (
            (demc.DemcError, "ours-2.exr exists, made with --model quality instead of fast", (source, ours, "fast")),
            (FileNotFoundError, "none.exr", (self.folder / "none.exr", self.folder / "new.exr", "fast")),
        ):
            with self.assertRaises(error) as caught:
                demc.denoise_exr(*arguments[:2], model=arguments[2])
            self.assertIn(text, str(caught.exception))
        demc.denoise_exr(source, ours, overwrite=True)

    @unittest.skipIf(os.name == "nt", "signals of Unix")
    def test_ctrl_c_ends_demc_infer_and_stops_demc_train(self) -> None:
        data = self.folder / "data"
        data.mkdir()
        for i in range(100):
            (data / f"{i}.exr").symlink_to(SAMPLE / "test" / "col-classroom-1.exr")
        out = self.folder / "out"
        command = [sys.executable, "-c", PROGRAM.format("infer", "infer"), "denoise", data, "-o", out]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
            while not (out.is_dir() and any(out.glob("*.exr"))):
                self.assertIsNone(process.poll())
            process.send_signal(signal.SIGINT)
            self.assertEqual(process.wait(timeout=60), -signal.SIGINT)
        sets = ["--set=train.steps=500", f"--set=data.root={SAMPLE}", "--run-dir", self.folder / "run"]
        command = [sys.executable, "-c", PROGRAM.format("train", "train"), "--config", CONFIG, *sets]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            while not process.stdout.readline().startswith("run: "):
                self.assertIsNone(process.poll())
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=120)
            self.assertEqual(process.returncode, 128 + signal.SIGINT)


if __name__ == "__main__":
    unittest.main()
