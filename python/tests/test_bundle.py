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
import torch
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

    def with_filter(self) -> None:
        torch.manual_seed(3)
        config = demc.ModelConfig("semc", width=2)
        model = demc.Denoiser(config)
        with torch.no_grad():
            for weight in model.parameters():
                weight += torch.empty_like(weight).uniform_(-0.05, 0.06)
        self.weights |= {f"albedo_filter.{name}": weight for name, weight in model.state_dict().items()}
        self.meta["albedo_filter"] = self.meta | {"model": asdict(config), "step": 9}

    def test_an_albedo_filter_is_applied_and_comes_back(self) -> None:
        self.write()
        plain = demc.load(self.path)
        self.with_filter()
        self.write()
        bundle = demc.load(self.path)
        self.assertEqual((bundle.step, bundle.albedo_filter.step), (7, 9))
        self.assertIsNone(bundle.albedo_filter.albedo_filter)
        self.assertEqual(bundle.tensors().keys(), self.weights.keys())

        images = torch.rand(2, 15, 32, 64, requires_grad=True)
        color, features = images[:, :3], images[:, 3:]
        filtered = bundle.with_filtered_albedo(features)
        kept = [channel for channel in range(12) if not 6 <= channel < 9]
        self.assertTrue(torch.equal(filtered[:, kept], features[:, kept]))
        self.assertFalse(torch.equal(filtered[:, 6:9], features[:, 6:9]))
        expected = plain.radiance(color, filtered)
        found = bundle.radiance(color, features)
        self.assertTrue(torch.equal(found, expected))
        found.sum().backward()
        self.assertTrue(images.grad.isfinite().all())
        self.assertIsNotNone(next(bundle.albedo_filter.model.parameters()).grad)
        # Of two images, one has constant albedo and keeps it.
        features = features.detach().clone()
        features[1, 6:9] = 0.25
        self.assertTrue(torch.equal(bundle.with_filtered_albedo(features)[1], features[1]))

        meta = bundle.meta
        save_file(bundle.tensors(), self.path, {"demc": json.dumps(meta)})
        again = demc.load(self.path).albedo_filter.model.state_dict()
        self.assertTrue(all(torch.equal(weight, again[name]) for name, weight in bundle.albedo_filter.model.state_dict().items()))

    def test_a_wrong_albedo_filter_is_named(self) -> None:
        self.with_filter()
        bias = self.weights.pop("albedo_filter.decoder.head.bias")
        self.write()
        with self.assertRaisesRegex(ValueError, "albedo_filter .*decoder.head.bias"):
            demc.load(self.path)
        self.weights["albedo_filter.decoder.head.bias"] = bias
        self.meta["albedo_filter"]["normalizer"] = self.meta["normalizer"] | {"position": "image"}
        self.write()
        with self.assertRaisesRegex(ValueError, "other positions"):
            demc.load(self.path)
        del self.meta["albedo_filter"]["step"]
        self.write()
        with self.assertRaisesRegex(ValueError, "no key albedo_filter.step$"):
            demc.load(self.path)
        # Without its header entry, the tensors are superfluous.
        del self.meta["albedo_filter"]
        self.write()
        with self.assertRaisesRegex(ValueError, "Unexpected.*albedo_filter"):
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
