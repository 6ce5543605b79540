"""Tests of `demc.torch.load`: run `python -m unittest discover -s tests` in `bindings/python/`."""

import json
import os
import subprocess
import sys
import tempfile
import unittest
from dataclasses import asdict
from pathlib import Path

import demc.torch
import numpy as np
import torch
from safetensors.torch import save_file

PACKAGE = Path(__file__).resolve().parents[1]


class Headers(unittest.TestCase):
    def setUp(self) -> None:
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.path = Path(directory.name) / "x.safetensors"
        config = demc.torch.ModelConfig(width=2)
        self.weights = demc.torch.Denoiser(config).state_dict()
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
        self.assertEqual(demc.torch.load(self.path).step, 7)

    def test_a_checksum_is_compared_and_left_out_of_the_header(self) -> None:
        blank = json.dumps(self.meta | {"sha256": ""})
        self.meta["sha256"] = demc.torch.bundle.checksum(blank, self.weights)
        self.write()
        self.assertNotIn("sha256", demc.torch.load(self.path).meta)
        name = next(iter(self.weights))
        self.weights[name] = self.weights[name] + 1
        self.write()
        with self.assertRaisesRegex(ValueError, "damaged: its checksum differs"):
            demc.torch.load(self.path)

    def with_filter(self) -> None:
        torch.manual_seed(3)
        config = demc.torch.ModelConfig("semc", width=2)
        model = demc.torch.Denoiser(config)
        with torch.no_grad():
            for weight in model.parameters():
                weight += torch.empty_like(weight).uniform_(-0.05, 0.06)
        self.weights |= {f"albedo_filter.{name}": weight for name, weight in model.state_dict().items()}
        self.meta["albedo_filter"] = self.meta | {"model": asdict(config), "step": 9}

    def test_an_albedo_filter_is_applied_and_comes_back(self) -> None:
        self.write()
        plain = demc.torch.load(self.path)
        self.with_filter()
        self.write()
        bundle = demc.torch.load(self.path)
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
        again = demc.torch.load(self.path).albedo_filter.model.state_dict()
        self.assertTrue(all(torch.equal(weight, again[name]) for name, weight in bundle.albedo_filter.model.state_dict().items()))

    def test_a_wrong_albedo_filter_is_named(self) -> None:
        self.with_filter()
        bias = self.weights.pop("albedo_filter.decoder.head.bias")
        self.write()
        with self.assertRaisesRegex(ValueError, "albedo_filter .*decoder.head.bias"):
            demc.torch.load(self.path)
        self.weights["albedo_filter.decoder.head.bias"] = bias
        self.meta["albedo_filter"]["normalizer"] = self.meta["normalizer"] | {"position": "image"}
        self.write()
        with self.assertRaisesRegex(ValueError, "other positions"):
            demc.torch.load(self.path)
        del self.meta["albedo_filter"]["step"]
        self.write()
        with self.assertRaisesRegex(ValueError, "no key albedo_filter.step$"):
            demc.torch.load(self.path)
        # Without its header entry, the tensors are superfluous.
        del self.meta["albedo_filter"]
        self.write()
        with self.assertRaisesRegex(ValueError, "Unexpected.*albedo_filter"):
            demc.torch.load(self.path)

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
                demc.torch.load(self.path)
            parent[keys[-1]] = value

    def test_a_file_without_levels_has_those_of_the_paper(self) -> None:
        del self.meta["model"]["levels"]
        self.write()
        self.assertEqual(demc.torch.load(self.path).model.config.levels, (1, 2, 4, 8, 8))

    def test_levels_are_those_of_the_file(self) -> None:
        config = demc.torch.ModelConfig(width=2, levels=(2, 3, 1, 1, 2))
        self.weights = demc.torch.Denoiser(config).state_dict()
        self.meta["model"] = asdict(config)
        self.write()
        model = demc.torch.load(self.path).model
        self.assertEqual(model.config, config)
        self.assertEqual(model.latent.conv.weight.shape, (4, 4, 3, 3))

    def test_the_name_contains_levels_that_differ_from_the_paper(self) -> None:
        self.assertEqual(str(demc.torch.ModelConfig(width=3)), "demc, paper reading, width 3")
        name = str(demc.torch.ModelConfig(width=3, levels=(1, 2, 2, 4, 1)))
        self.assertEqual(name, "demc, paper reading, width 3, levels of [3, 6, 6, 12, 3]")

    def test_levels_are_five(self) -> None:
        for levels in ([1, 2, 4, 8], [1, 2, 4, 8, 0]):
            self.meta["model"]["levels"] = levels
            self.write()
            with self.assertRaisesRegex(ValueError, "expected five numbers of at least 1"):
                demc.torch.load(self.path)

    def kernel_bundle(self) -> demc.torch.Bundle:
        """A network whose kernels differ from pixel to pixel, with albedo demodulation."""
        torch.manual_seed(4)
        config = demc.torch.ModelConfig(width=2, head="kernel")
        model = demc.torch.Denoiser(config)
        with torch.no_grad():
            for weight in model.decoder.kernels.parameters():
                weight.uniform_(-1, 1)
        self.weights = model.state_dict()
        self.meta["model"] = asdict(config)
        self.meta["normalizer"] |= {"demodulate": 0.07, "exposure_level": 0.13}
        self.write()
        return demc.torch.load(self.path)

    def test_layers_that_add_up_to_the_colour_still_do(self) -> None:
        bundle = self.kernel_bundle()
        random = np.random.default_rng(1)
        passes = 5 * random.random((2, 3, 40, 70), np.float32) ** 8
        color, features = passes.sum(0), random.random((12, 40, 70), np.float32)
        names = [f"{part}.{color}" for part in ("Diffuse", "lamp") for color in "RGB"]
        layers = dict(zip(names, passes.reshape(6, 40, 70)))
        layers |= {"flat.A": np.full((40, 70), 0.4), "flat.Z": np.full((40, 70), -3.0)}
        image, filtered = bundle.denoise_with_layers(color, features, layers)
        self.assertEqual(list(filtered), list(layers))
        np.testing.assert_array_equal(image, bundle.denoise(color, features))
        total = np.stack([filtered[name] for name in names]).reshape(2, 3, 40, 70).sum(0)
        self.assertLessEqual(abs(total - image).max(), 1e-4 * image.max())
        self.assertGreater(abs(total - color).max(), 0.1)
        for name in ("flat.A", "flat.Z"):
            np.testing.assert_allclose(filtered[name], layers[name], rtol=1e-5)
        # The albedo of its own colour: constant light stays.
        lit = {"x.g": 0.5 * (features[7] + 0.07)}
        np.testing.assert_allclose(bundle.denoise_with_layers(color, features, lit)[1]["x.g"], lit["x.g"], rtol=1e-5)

    def plain_bundle(self, variant: str) -> demc.torch.Bundle:
        """A network without kernels that restores light; DEMC also demodulates."""
        torch.manual_seed(5)
        width = 64 if variant == "unet" else 2
        config = demc.torch.ModelConfig(variant, width=width, size="small")
        model = (demc.torch.Denoiser if variant == "demc" else demc.torch.Unet)(config)
        own = {"demodulate": 0.07} if variant == "demc" else {"transfer": "pu"}
        with torch.no_grad():
            for weight in [] if variant == "demc" else model.head.parameters():
                # The image is not black, and its radiance not beyond floats.
                weight.copy_(0.1 * weight.abs() + 1e-3)
        self.weights = model.state_dict()
        self.meta["model"] = asdict(config)
        self.meta["normalizer"] |= own | {"exposure_level": 0.18, "restore_light": True}
        self.write()
        return demc.torch.load(self.path)

    def test_layers_of_a_network_without_kernels_are_images(self) -> None:
        random = np.random.default_rng(2)
        passes = 5 * random.random((2, 3, 40, 70), np.float32) ** 8 * np.float32([[[[1]]], [[[20]]]])
        color, features = passes.sum(0), random.random((12, 40, 70), np.float32)
        for variant in ("demc", "unet", "unet-nosn"):
            bundle = self.plain_bundle(variant)
            # Blue comes first, as in files.
            key, rim = ({f"{name}.{end}": light[i] for i, end in ((2, "B"), (1, "g"), (0, "R"))} for name, light in zip(("key", "rim"), passes))
            image, filtered = bundle.denoise_with_layers(color, features, key | {"A": color[0]} | rim)
            np.testing.assert_array_equal(image, bundle.denoise(color, features))
            self.assertEqual(list(filtered), [*key, "A", *rim])
            total = sum(np.stack([filtered[f"{name}.{end}"] for end in "RgB"]) for name in ("key", "rim"))
            self.assertLessEqual(abs(total - image).max(), 1e-4 * image.max())
            # A light alone is not the colour. Its result is that of an image.
            _, alone = bundle.denoise_with_layers(color, features, rim)
            expected = bundle.denoise(passes[1], features)
            np.testing.assert_array_equal(np.stack([alone[name] for name in ("rim.R", "rim.g", "rim.B")]), expected)
            bundle.demodulate = 0
            grey = bundle.denoise(np.stack([color[0]] * 3), features).mean(0)
            np.testing.assert_array_equal(filtered["A"], grey)

    def test_layers_with_three_colours_of_a_name_are_an_image(self) -> None:
        names = ["key.B", "A", "key.G", "rim.r", "key.R", "rim.G", "rim.b", "R", "B", "G", "key.r", "fill.R", "fill.G"]
        images = [("key.R", "key.G", "key.B"), ("A",), ("rim.r", "rim.G", "rim.b"), ("R", "G", "B")]
        images += [("key.r",), ("fill.R",), ("fill.G",)]
        self.assertEqual(demc.torch.layers.layer_images(names), images)

    def test_layers_that_cannot_be_denoised_are_refused(self) -> None:
        color, features = np.ones((3, 8, 8)), np.ones((12, 8, 8))
        self.meta["model"] |= {"variant": "kpcn"}
        self.weights = demc.torch.Kpcn(demc.torch.ModelConfig("kpcn", width=2)).state_dict()
        self.write()
        with self.assertRaisesRegex(ValueError, "a kpcn model denoises no layers"):
            demc.torch.load(self.path).denoise_with_layers(color, features, {"A": color[0]})
        bundle = self.kernel_bundle()
        for plane, words in ((np.ones((8, 7)), r"\[8, 7\]: expected \[8, 8\]"), (np.full((8, 8), np.nan), "NaN")):
            with self.assertRaisesRegex(ValueError, f"layer lamp.R .*{words}"):
                bundle.denoise_with_layers(color, features, {"lamp.R": plane})

    def test_the_command_prints_one_line(self) -> None:
        del self.meta["normalizer"]
        self.write()
        command = [sys.executable, "-m", "demc.torch", str(self.path)]
        environment = os.environ | {"PYTHONPATH": str(PACKAGE)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        self.assertEqual(done.returncode, 1)
        self.assertEqual(done.stderr, f"error: {self.path}: header entry 'demc': no key normalizer\n")


if __name__ == "__main__":
    unittest.main()
