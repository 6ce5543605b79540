"""Tests of `demc.load`: run `python -m unittest discover -s tests` in `python/`."""

import json
import os
import subprocess
import sys
import tempfile
import unittest
from dataclasses import asdict
from pathlib import Path

import demc
from safetensors.torch import save_file

PACKAGE = Path(__file__).resolve().parents[1]


class Headers(unittest.TestCase):
    def setUp(self) -> None:
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.path = Path(directory.name) / "x.safetensors"
        config = demc.ModelConfig(width=2)
        self.weights = demc.Denoiser(config).state_dict()
        features = {"mean": [0.0] * 12, "std": [1.0] * 12}
        self.meta = {
            "format": 1,
            "model": asdict(config),
            "normalizer": {"gamma": 2.2, "features": features},
            "step": 7,
        }

    def write(self) -> None:
        weights = {name: weight.contiguous() for name, weight in self.weights.items()}
        save_file(weights, self.path, {"demc": json.dumps(self.meta)})

    def test_a_whole_header_loads(self) -> None:
        self.write()
        self.assertEqual(demc.load(self.path).step, 7)

    def test_a_checksum_is_compared_and_left_out_of_the_header(self) -> None:
        blank = json.dumps(self.meta | {"sha256": ""})
        self.meta["sha256"] = demc.bundle.checksum(blank, self.weights)
        self.write()
        self.assertNotIn("sha256", demc.load(self.path).meta)
        name = next(iter(self.weights))
        self.weights[name] = self.weights[name] + 1
        self.write()
        with self.assertRaisesRegex(ValueError, "damaged: its checksum differs"):
            demc.load(self.path)

    def test_a_missing_key_is_named(self) -> None:
        for keys in (
            ["format"],
            ["model"],
            ["step"],
            ["normalizer"],
            ["normalizer", "gamma"],
            ["normalizer", "features"],
            ["normalizer", "features", "std"],
        ):
            parent = self.meta
            for key in keys[:-1]:
                parent = parent[key]
            value = parent.pop(keys[-1])
            self.write()
            with self.subTest(keys), self.assertRaisesRegex(ValueError, f"no key {'.'.join(keys)}$"):
                demc.load(self.path)
            parent[keys[-1]] = value

    def test_a_file_without_levels_has_those_of_the_paper(self) -> None:
        del self.meta["model"]["levels"]
        self.write()
        self.assertEqual(demc.load(self.path).model.config.levels, (1, 2, 4, 8, 8))

    def test_levels_are_those_of_the_file(self) -> None:
        config = demc.ModelConfig(width=2, levels=(2, 3, 1, 1, 2))
        self.weights = demc.Denoiser(config).state_dict()
        self.meta["model"] = asdict(config)
        self.write()
        model = demc.load(self.path).model
        self.assertEqual(model.config, config)
        self.assertEqual(model.latent.conv.weight.shape, (4, 4, 3, 3))

    def test_the_name_contains_levels_that_differ_from_the_paper(self) -> None:
        self.assertEqual(str(demc.ModelConfig(width=3)), "demc, paper reading, width 3")
        name = str(demc.ModelConfig(width=3, levels=(1, 2, 2, 4, 1)))
        self.assertEqual(name, "demc, paper reading, width 3, levels of [3, 6, 6, 12, 3]")

    def test_levels_are_five(self) -> None:
        for levels in ([1, 2, 4, 8], [1, 2, 4, 8, 0]):
            self.meta["model"]["levels"] = levels
            self.write()
            with self.assertRaisesRegex(ValueError, "expected five numbers of at least 1"):
                demc.load(self.path)

    def test_the_command_prints_one_line(self) -> None:
        del self.meta["normalizer"]
        self.write()
        command = [sys.executable, "-m", "demc", str(self.path)]
        environment = os.environ | {"PYTHONPATH": str(PACKAGE)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        self.assertEqual(done.returncode, 1)
        self.assertEqual(done.stderr, f"error: {self.path}: header entry 'demc': no key normalizer\n")


if __name__ == "__main__":
    unittest.main()
