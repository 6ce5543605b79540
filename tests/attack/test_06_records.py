"""Item 6: damaged records of a run count as missing, and a damaged line of the log costs that line."""
import json
import random
import shutil

from common import LONG, REPOSITORY, Attack

CLOCK = ("patches_per_s", "elapsed_s")


def harms(rng, whole):
    """Damaged versions of a file, by name."""
    flips = {}
    for number in range(12 if LONG else 3):
        bit = rng.randrange(8 * len(whole))
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        flips[f"bit {bit}"] = bytes(changed)
    return {"empty": b"", "cut short": whole[:len(whole) // 2], "zeros": bytes(len(whole)),
            "not UTF-8": b"\xff\xfe" + whole, "another": b"{}", **flips}


class Records(Attack):
    def train(self, *options):
        return self.run_program("demc-train", "--config", "tiny.toml", "--resume", *options)

    def log(self):
        lines = [json.loads(line) for line in (self.root / "run" / "metrics.jsonl").read_text().splitlines()]
        return [{key: value for key, value in line.items() if key not in CLOCK} for line in lines]

    def test_06_damaged_records_come_from_the_checkpoint(self):
        rng = random.Random(6)
        for name in ("run.json", "config.toml"):
            path = self.root / "run" / name
            whole = path.read_bytes()
            for harm, damaged in harms(rng, whole).items():
                path.write_bytes(damaged)
                result = self.train()
                with self.subTest(name=name, harm=harm):
                    # A configuration may stay valid. Then it is another run, whose keys are named.
                    if name == "config.toml" and "another configuration" in result.stderr:
                        self.assert_refused(result, "instead of")
                    elif not (name == "config.toml" and harm.startswith("bit") and path.read_bytes() == damaged):
                        self.assertEqual(result.code, 0, result)
                        self.assertIn(f"{name} was damaged: restored from", result.stdout)
                        self.assertEqual(path.read_bytes(), whole)
                path.write_bytes(whole)

    def test_06_damaged_records_without_a_checkpoint(self):
        shutil.rmtree(self.root / "run" / "checkpoints")
        (self.root / "run" / "latest").unlink()
        for name in ("run.json", "config.toml"):
            path = self.root / "run" / name
            whole = path.read_bytes()
            path.write_bytes(whole[:40])
            result = self.train()
            with self.subTest(name):
                self.assertEqual(result.code, 0, result)
                self.assertIn(f"{name} was damaged", result.stdout)
                self.assertNotIn("damaged", self.train().stdout)
                if name == "run.json":
                    self.assertEqual(path.read_bytes(), whole)
            shutil.rmtree(self.root / "run" / "checkpoints")
            (self.root / "run" / "latest").unlink()

    def test_06_a_damaged_layout_or_latest(self):
        shutil.copy(REPOSITORY / "configs" / "renderers" / "demc-exr.toml", self.root / "mine.toml")
        options = ["--run-dir", "r", "--set", "data.layout=mine.toml"]
        result = self.run_program("demc-train", "--config", "tiny.toml", *options)
        self.assertEqual(result.code, 0, result)
        rng = random.Random(7)
        for name, words in (("layout.toml", "layout.toml was damaged: restored from"), ("latest", "latest: ")):
            path = self.root / "r" / name
            whole = path.read_bytes()
            for harm in ("empty", "cut short", "zeros", "not UTF-8"):
                for command in (["--config", "tiny.toml", *options], ["--config", "r/config.toml"]):
                    path.write_bytes(harms(rng, whole)[harm])
                    result = self.run_program("demc-train", *command, "--resume")
                    with self.subTest(name=name, harm=harm, command=command[1]):
                        self.assertEqual(result.code, 0, result)
                        self.assertIn(words, result.stdout)
                    path.write_bytes(whole)

    def test_06_a_damaged_configuration_names_its_copy(self):
        (self.root / "run" / "config.toml").write_text("[model\n")
        result = self.run_program("demc-train", "--config", "run/config.toml", "--resume")
        self.assert_refused(result, "run/config.toml:1", "checkpoints/step-00000002/config.toml", code=2)
        result = self.run_program("demc-train", "--config", "run/checkpoints/step-00000002/config.toml", "--resume")
        self.assertEqual(result.code, 0, result)

    def test_06_a_damaged_line_costs_that_line(self):
        path = self.root / "run" / "metrics.jsonl"
        first, second = path.read_bytes().splitlines(True)
        whole = self.log()
        bad = [b"\n", b"x\n", b"{}\n", b"\xff\xfe\n", b'{"step": -1}\n', b'{"step": "1"}\n', b"\0" * 50 + b"\n",
               first[:-10] + b"\n", b"[1, 2]\n", b"null\n"]
        for line in bad:
            for lines in ([line, first, second], [first, line, second], [first, second, line]):
                path.write_bytes(b"".join(lines))
                result = self.train()
                with self.subTest(line=line, place=lines.index(line)):
                    self.assertEqual(result.code, 0, result)
                    self.assertIn(f"damaged line {lines.index(line) + 1} removed", result.stdout)
                    self.assertEqual(self.log(), whole)
        # What a killed process leaves is no damage.
        path.write_bytes(first + second + second[:20])
        result = self.train()
        self.assertNotIn("damaged", result.stdout)
        self.assertEqual(self.log(), whole)

    def test_06_curves_skip_a_damaged_line(self):
        path = self.root / "run" / "metrics.jsonl"
        path.write_bytes(b"\xff\n" + path.read_bytes())
        result = self.run_program("demc-train", "plot", "run")
        self.assertEqual(result.code, 0, result)
        self.assertIn("damaged line 1 skipped", result.stdout)
