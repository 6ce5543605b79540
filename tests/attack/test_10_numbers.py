"""Item 10: a number that passes --check does not end the training with a panic."""
import random

from common import LONG, Attack

INTEGERS = ["model.width", "data.patch_size", "data.stride", "data.batch_size", "data.cache_mib", "data.workers",
            "optimizer.warmup_steps", "optimizer.muon_max_rows", "train.steps", "train.seed",
            "train.grad_accumulation", "run.log_every", "run.validate_every", "run.checkpoint_every", "run.keep",
            "run.keep_every"]
REALS = ["data.gamma", "data.albedo_demodulation_epsilon", "data.exposure_level", "data.validation", "loss.relmse",
         "loss.dssim", "loss.smape", "loss.l1", "loss.relmse_epsilon", "optimizer.lr_start", "optimizer.lr_end",
         "optimizer.adam_epsilon", "optimizer.max_grad_norm", "train.ema_decay", "run.checkpoint_minutes"]
EXTREMES = {"integer": ["0", "1", "-1", "4294967296", "9007199254740993", "9223372036854775807", "1000000000"],
            "real": ["0.0", "-0.0", "-1.0", "1e-300", "5e-324", "4e17", "1e30", "1e300", "inf", "-inf", "nan",
                     "525600.0", "1e-9", "0.999999999999"]}
# Allowed, but too large for a test: a network, a batch, a number of steps.
SLOW = {"train.steps", "train.grad_accumulation", "data.batch_size", "model.width", "data.patch_size"}


class Numbers(Attack):
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
