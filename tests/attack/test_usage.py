"""The project that every attack starts from; extreme numbers (item 10); wrong usage (item 21)."""
import random
import shutil

from common import LONG, Attack

INTEGERS = ["model.width", "data.patch_size", "data.stride", "data.batch_size", "data.cache_mib", "data.workers",
            "optimizer.warmup_steps", "optimizer.muon_max_rows", "train.steps", "train.seed",
            "train.grad_accumulation", "run.log_every", "run.validate_every", "run.checkpoint_every", "run.keep"]
REALS = ["data.gamma", "data.albedo_demodulation_epsilon", "data.exposure_level", "data.validation", "loss.relmse",
         "loss.dssim", "loss.smape", "loss.l1", "loss.relmse_epsilon", "optimizer.lr_start", "optimizer.lr_end",
         "optimizer.max_grad_norm", "train.ema_decay", "run.checkpoint_minutes"]
EXTREMES = {"integer": ["0", "1", "-1", "4294967296", "9007199254740993", "9223372036854775807", "1000000000"],
            "real": ["0.0", "-0.0", "-1.0", "1e-300", "5e-324", "4e17", "1e30", "1e300", "inf", "-inf", "nan",
                     "525600.0", "1e-9", "0.999999999999"]}
# Allowed, but too large for a test: a network, a batch, a number of steps.
SLOW = {"train.steps", "train.grad_accumulation", "data.batch_size", "model.width", "data.patch_size"}


class Setup(Attack):
    def test_00_the_project_denoises(self):
        result = self.run_program("demc-infer", "denoise", "frame.exr", "-o", "out.exr", "--model", "model.safetensors")
        self.assertEqual(result.code, 0, result)
        self.assertTrue((self.root / "out.exr").is_file())


class Numbers(Attack):
    """A number that passes --check does not end the training with a panic."""

    def test_10_extreme_numbers(self):
        cases = [(key, value) for keys, kind in ((INTEGERS, "integer"), (REALS, "real"))
                 for key in keys for value in EXTREMES[kind]]
        fixed = [("run.checkpoint_minutes", value) for value in EXTREMES["real"]]
        if not LONG:
            cases = fixed + random.Random(10).sample(cases, 60)
        muon = ["--set", "optimizer.kind=muon"]
        for key, value in cases:
            options = ["--config", "tiny.toml", "--run-dir", f"r-{key}-{value}", "--set", f"{key}={value}",
                       *(muon if "muon" in key else [])]
            with self.subTest(key=key, value=value):
                check = self.run_program("demc-train", *options, "--check")
                if check.code == 2:
                    self.assertIn(f"--set {key}={value}: ", check.stderr, check)
                elif check.code == 0 and key not in SLOW:
                    result = self.run_program("demc-train", *options)
                    self.assertTrue(result.code == 0 or "non-finite" in result.stderr, result)


class Usage(Attack):
    def check(self, *sets, config="tiny.toml"):
        sets = [option for text in sets for option in ("--set", text)]
        return self.run_program("demc-train", "--config", config, "--run-dir", "r", *sets, "--check")

    def test_21_tables_are_no_keys(self):
        for table in ("model", "data", "loss", "optimizer", "train", "run"):
            for value in ("3", "", "{}", "x"):
                with self.subTest(table=table, value=value):
                    result = self.check(f"{table}={value}")
                    self.assert_refused(result, f"`{table}` is a table", f"{table}.", code=2)
                    self.assertNotIn("did you mean", result.stderr)

    def test_21_bad_values_are_blamed_on_their_source(self):
        bad = {"data.batch_size": "0", "data.gamma": "nan", "data.root": '""', "data.layout": '""',
               "model.width": "0", "loss.relmse": "-1.0", "optimizer.lr_start": "-1.0", "train.steps": "0",
               "train.ema_decay": "2.0", "run.keep": "0", "train.init": '""'}
        for key, value in bad.items():
            with self.subTest(key):
                result = self.check(f"{key}={value}")
                self.assert_refused(result, f"--set {key}={value}: {key} = ", code=2)
                self.assertNotIn("tiny.toml", result.stderr)
        tables = {}
        for key, value in bad.items():
            table, name = key.split(".")
            tables.setdefault(table, []).append(f"{name} = {value}\n")
        text = "".join(f"[{table}]\n{''.join(lines)}" for table, lines in tables.items())
        (self.root / "bad.toml").write_text(text)
        result = self.check(config="bad.toml")
        self.assert_refused(result, "error: bad.toml: ", *(f"{key} = " for key in bad), code=2)
        self.assertNotIn("--set", result.stderr)
        # A valid edit hides no problem of the file, and a later edit counts.
        result = self.check("data.batch_size=0", "data.batch_size=1", "run.keep=0", config="bad.toml")
        self.assert_refused(result, "--set run.keep=0: run.keep = 0", "bad.toml: ", "data.gamma", code=2)
        self.assertNotIn("data.batch_size = ", result.stderr)
        self.assert_refused(self.check("loss.relmse=0"), "--set loss.relmse=0: loss: at least one", code=2)

    def test_21_numbers_beyond_toml(self):
        for key in ("train.seed", "train.steps", "data.validation"):
            for value in ("9223372036854775808", "18446744073709551616", "9" * 40, "007", "1e999"):
                with self.subTest(key=key, value=value):
                    result = self.check(f"{key}={value}")
                    self.assertEqual(result.code, 2, result)
                    self.assertNotIn("string", result.stderr)
        (self.root / "seed.toml").write_text("[train]\nseed = 9223372036854775808\n")
        result = self.check(config="seed.toml")
        self.assert_refused(result, "seed.toml:2", code=2)
        self.assertNotIn("string", result.stderr)
        self.assertEqual(self.check("train.seed=9223372036854775807").code, 0)

    def test_21_names_that_look_like_numbers(self):
        shutil.copytree(self.root / "data", self.root / "2024")
        for value in ("2024", '"2024"', "./2024"):
            with self.subTest(value):
                self.assertEqual(self.check(f"data.root={value}").code, 0)

    def test_21_edits_are_one_line(self):
        for text in ("train.steps=3\ntrain.seed=4", "train.steps=3\n", "train.steps=3 # x", "data.root=data\r",
                     "train.steps=[\n3]", "train.steps=3\x1b[31m", "train.steps=3 4"):
            with self.subTest(text):
                result = self.check(text)
                self.assertEqual(result.code, 2, result)
                self.assertNotIn("\x1b", result.stderr)
                self.assertEqual(result.stderr.count("\n"), 1, result)

    def test_21_wrong_usage_has_code_2(self):
        shutil.copytree(self.root / "run", self.root / "other")
        plot, sweep = ["demc-train", "plot"], ["demc-train", "find-lr", "--config", "tiny.toml"]
        denoise = ["demc-infer", "denoise", "frame.exr", "-o", "o.exr", "--png"]
        cases = [[*plot], [*plot, "run", "run"], [*plot, "run", "./run/"],
                 *([*plot, "run", "--smooth", value] for value in ("1", "2", "-1", "nan", "inf", "x", "")),
                 *([*sweep, "--from", value] for value in ("0", "-1", "nan", "inf", "2", "x")),
                 *([*sweep, "--to", value] for value in ("0", "-1", "nan", "inf", "1e-7", "x")),
                 *([*sweep, "--steps", value] for value in ("0", "9", "-1", "1.5", "99999999999", "x")),
                 [*sweep, "-o", "/"], [*sweep, "-o", ".."], [*sweep, "--set", "train=3"], [*sweep, "--device", "x"],
                 ["demc-train", "find-lr", "--config", "none.toml"], ["demc-train", "ablate", "--config", "none.toml"],
                 ["demc-train", "--config", "tiny.toml", "--run-dir", ""], ["demc-train", "--config", "none.toml"],
                 *([*denoise, "--exposure", value] for value in ("nan", "inf", "-inf", "1e9", "-1000", "x", ""))]
        for command in cases:
            with self.subTest(command):
                before = sorted(path.name for path in self.root.rglob("*"))
                result = self.run_program(*command, timeout=30)
                self.assertEqual(result.code, 2, result)
                self.assertEqual(sorted(path.name for path in self.root.rglob("*")), before)
        for value in ("-3", "0", "2.5", "128"):
            result = self.run_program(*denoise, "--exposure", value, "--overwrite", "--model", "model.safetensors")
            self.assertEqual(result.code, 0, result)

    def test_21_an_empty_log_draws_nothing(self):
        path = self.root / "run" / "metrics.jsonl"
        for text in ("", "\n", '{"step": 1, "loss": null}\n', '{"step": 1', "x\n"):
            path.write_text(text)
            with self.subTest(text):
                self.assert_refused(self.run_program("demc-train", "plot", "run"), "metrics.jsonl", "no values")
                self.assertFalse((self.root / "run" / "curves.svg").exists())

    def test_21_short_images(self):
        whole = (self.root / "frame.exr").read_bytes()
        for length, words in ((0, "it is empty"), (3, "it is cut short"), (100, "it is cut short"),
                              (1000, "it is cut short")):
            (self.root / "short.exr").write_bytes(whole[:length])
            for command in (["demc-data", "inspect", "short.exr"],
                            ["demc-infer", "check", "short.exr", "--model", "model.safetensors"],
                            ["demc-infer", "denoise", "short.exr", "-o", "o.exr", "--model", "model.safetensors"]):
                with self.subTest(length=length, command=command[:2]):
                    self.assert_refused(self.run_program(*command), "short.exr", words)
