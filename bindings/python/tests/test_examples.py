"""Tests that the examples give the same images as `demc-infer denoise`, and that `finetune.py` works.

They need `demc-infer` on the `PATH`, PyTorch, ONNX Runtime, and OpenEXR. Without these they are
skipped, unless DEMC_REQUIRE_EXAMPLES=1.
"""

import importlib.util
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from dataclasses import asdict
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
ROOT = PACKAGE.parents[1]
SAMPLE = ROOT / "data" / "sample"
RENDERERS = ROOT / "tests" / "renderers" / "files"
FILES = [
    *(RENDERERS / f"{name}.exr" for name in ("cycles-4.5", "cycles-5.0", "mitsuba-3.9")),
    *sorted((SAMPLE / "test").glob("*.exr")),
]
TOLERANCE = 1e-4
"""Largest difference, relative to the largest value of the image: the rounding of three runtimes."""
MISSING = [name for name in ["numpy", "OpenEXR", "torch", "onnxruntime"] if importlib.util.find_spec(name) is None]
if shutil.which("demc-infer") is None:
    MISSING.append("demc-infer")


def run(*command: object) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(PACKAGE)}
    return subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True)


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_EXAMPLES") != "1", f"no {', '.join(MISSING)}")
class Examples(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        directory = tempfile.TemporaryDirectory()
        cls.addClassCleanup(directory.cleanup)
        cls.folder = Path(directory.name)
        cls.models = {"torch": cls.folder / "demc.safetensors", "onnx": cls.folder / "demc.onnx"}
        cls.succeed("demc-infer", "export", "--names", "torch", "-o", cls.models["torch"])
        cls.succeed("demc-infer", "export", "--format", "onnx", "-o", cls.models["onnx"])

    @classmethod
    def succeed(cls, *command: object) -> str:
        done = run(*command)
        if done.returncode != 0:
            raise AssertionError(f"{command}: {done.stderr}")
        return done.stdout

    def example(self, kind: str, source: Path, *options: str) -> subprocess.CompletedProcess:
        script = PACKAGE / "examples" / f"{kind}_denoise.py"
        return run(sys.executable, script, self.models[kind], source, self.folder / f"{kind}.exr", *options)

    def test_both_give_the_image_and_the_channels_of_demc_infer(self) -> None:
        import numpy as np
        from demc.torch.exr import ExrFile

        expected = self.folder / "rust.exr"
        for source in FILES:
            self.succeed("demc-infer", "denoise", source, "-o", expected, "--overwrite", "--precision", "float")
            noisy, theirs = ExrFile(source), ExrFile(expected)
            for kind in self.models:
                done = self.example(kind, source)
                self.assertEqual(done.returncode, 0, done.stderr)
                ours = ExrFile(self.folder / f"{kind}.exr")
                self.assertEqual(list(ours.channels), list(theirs.channels))
                changed = 0
                for name, channel in theirs.channels.items():
                    mine = ours.channels[name].pixels
                    largest = np.abs(channel.pixels).max()
                    with self.subTest(source.name, kind=kind, channel=name):
                        self.assertEqual(mine.dtype, channel.pixels.dtype)
                        self.assertLessEqual(np.abs(mine - channel.pixels).max(), TOLERANCE * largest)
                    changed += not np.array_equal(mine, noisy.channels[name].pixels)
                self.assertEqual(changed, 3)

    def unet_model(self) -> Path:
        """A random U-Net whose image is not black, with light restored and the albedo filter of a bundled model."""
        import demc.torch
        import torch
        from safetensors.torch import save_file

        bundle = demc.torch.load(self.models["torch"])
        torch.manual_seed(5)
        config = demc.torch.ModelConfig("unet", size="small")
        bundle.model = demc.torch.Unet(config)
        with torch.no_grad():
            for weight in bundle.model.head.parameters():
                weight.copy_(0.1 * weight.abs() + 1e-3)
        normalizer = bundle.meta["normalizer"] | {"transfer": "pu", "exposure_level": 0.18, "restore_light": True}
        normalizer.pop("demodulate", None)
        normalizer["features"] = {"mean": [0.0] * 12, "std": [1.0] * 12}
        meta = bundle.meta | {"model": asdict(config), "normalizer": normalizer}
        path = self.folder / "unet.safetensors"
        save_file(bundle.tensors(), path, {"demc": json.dumps(meta)})
        return path

    def kernel_model(self) -> Path:
        """A random network whose kernels differ from pixel to pixel, with the albedo filter of a bundled model."""
        import demc.torch
        import torch
        from safetensors.torch import save_file

        bundle = demc.torch.load(self.models["torch"])
        torch.manual_seed(4)
        config = demc.torch.ModelConfig(width=4, head="kernel")
        bundle.model = demc.torch.Denoiser(config)
        with torch.no_grad():
            for weight in bundle.model.decoder.kernels.parameters():
                weight.uniform_(-1, 1)
        path = self.folder / "kernel.safetensors"
        save_file(bundle.tensors(), path, {"demc": json.dumps(bundle.meta | {"model": asdict(config)})})
        return path

    def file_with_groups(self, source: Path) -> Path:
        """Blender's file with two light groups that add up to its colour."""
        import numpy as np
        import OpenEXR

        channels = OpenEXR.File(str(source), separate_channels=True).channels()
        planes = {name: channel.pixels for name, channel in channels.items()}
        random = np.random.default_rng(3)
        for end in "RGB":
            color = np.float32(planes[f"ViewLayer.Combined.{end}"])
            planes[f"ViewLayer.Combined_key.{end}"] = color * random.uniform(0, 1, color.shape).astype(np.float32)
            planes[f"ViewLayer.Combined_fill.{end}"] = color - planes[f"ViewLayer.Combined_key.{end}"]
        path = self.folder / source.name
        OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(path))
        return path

    def test_layers_are_those_of_demc_infer(self) -> None:
        import numpy as np
        from demc.torch.exr import ExrFile

        expected, found = self.folder / "rust.exr", self.folder / "torch.exr"
        sources = self.file_with_groups(RENDERERS / "cycles-4.5.exr"), RENDERERS / "cycles-alpha.exr"
        for model, source in itertools.product((self.kernel_model(), self.unet_model()), sources):
            has_groups = source == sources[0]
            layers = "--layers", "*.A", "--layers", "*Depth*", *(["--layers", "*_[fk]*"] * has_groups)
            options = "--model", model, "--overwrite", "--precision", "float", *layers
            self.succeed("demc-infer", "denoise", source, "-o", expected, *options)
            self.succeed(sys.executable, PACKAGE / "examples" / "torch_denoise.py", model, source, found, *layers)
            noisy, theirs, ours = (ExrFile(path).channels for path in (source, expected, found))
            changed = []
            for channel in theirs:
                mine, other = ours[channel].pixels, theirs[channel].pixels
                with self.subTest(source.name, model=model.name, channel=channel):
                    self.assertLessEqual(np.abs(mine - other).max(), TOLERANCE * np.abs(other).max())
                changed += [channel] if not np.array_equal(mine, noisy[channel].pixels) else []
            # A network without kernels keeps a grey layer of one value: the first file's alpha.
            greys = [name for name in changed if name.endswith((".A", "Depth.Z"))]
            self.assertEqual(len(greys), 1 if has_groups and "unet" in model.name else 2, changed)
            for end in "RGB" if has_groups else "":
                image, key, fill = (ours[f"ViewLayer.Combined{group}.{end}"].pixels for group in ("", "_key", "_fill"))
                self.assertLessEqual(np.abs(image - key - fill).max(), TOLERANCE * image.max())

    def test_a_mistake_is_one_line(self) -> None:
        for kind in self.models:
            for source, options, message in [
                (FILES[0], ["--layer", "Glass"], 'no view layer "Glass"; there is ViewLayer'),
                (FILES[0], ["--layout", "blender"], "neither a preset"),
                (FILES[2], ["--layout", "demc-exr"], "no channel albedo1.R"),
                (SAMPLE / "none.exr", [], "No such file"),
            ]:
                done = self.example(kind, source, *options)
                self.assertEqual((done.returncode, done.stderr.count("\n")), (1, 1), done.stderr)
                self.assertTrue(done.stderr.startswith("error: "), done.stderr)
                self.assertIn(message, done.stderr)

    def test_fine_tuned_weights_are_imported(self) -> None:
        names = "filtered", "tuned", "imported"
        filtered, tuned, imported = (self.folder / f"{name}.safetensors" for name in names)
        options = "--names", "torch", "--albedo-filter", self.models["torch"]
        self.succeed("demc-infer", "export", *options, "-o", filtered)
        script = PACKAGE / "examples" / "finetune.py"
        options = "--steps", "3", "--batch", "2"
        text = self.succeed(sys.executable, script, filtered, tuned, "--data", SAMPLE, *options)
        self.assertIn("step 3: RelMSE ", text)
        self.succeed("demc-infer", "import", tuned, "-o", imported)
        meta = [json.loads(self.succeed("demc-infer", "inspect", "--json", "--model", path)) for path in (filtered, imported)]
        self.assertEqual(meta[1]["step"], meta[0]["step"] + 3)
        self.assertEqual(meta[1]["albedo_filter"], meta[0]["albedo_filter"])

        done = run(sys.executable, script, self.models["torch"], tuned, "--data", self.folder)
        self.assertEqual((done.returncode, done.stderr.count("\n")), (1, 1), done.stderr)


if __name__ == "__main__":
    unittest.main()
