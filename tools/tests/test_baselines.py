"""Tests of `tools/baselines.py` and `tools/references.py` on data/sample.

Run `python -m unittest discover -s tools/tests`. The tests are skipped without the tools'
packages (numpy, OpenEXR, pyoidn, scikit-image, PyWavelets), unless DEMC_REQUIRE_BASELINES=1.
"""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT / "tools"
SAMPLE = ROOT / "data" / "sample"
RENDERERS = ROOT / "tests" / "renderers" / "files"
NEEDED = ["numpy", "OpenEXR", "pyoidn", "skimage", "pywt"]
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]


def run(tool: str, *arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, TOOLS / f"{tool}.py", *map(str, arguments)], capture_output=True, text=True)


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_BASELINES") != "1", f"no {', '.join(MISSING)}")
class Tools(unittest.TestCase):
    """Puts the tools' folder first on the path."""

    def setUp(self) -> None:
        sys.path.insert(0, str(TOOLS))
        self.addCleanup(sys.path.remove, str(TOOLS))


class Baselines(Tools):
    def relmse(self, denoiser: str) -> list[tuple[float, float]]:
        """RelMSE of the noisy and of the denoised image, per scene."""
        import numpy as np
        from demc.torch.exr import ExrFile

        scores = []
        with tempfile.TemporaryDirectory() as out:
            ended = run("baselines", denoiser, "--data", SAMPLE, "-o", out)
            self.assertEqual(ended.returncode, 0, ended.stderr)
            scenes = sorted((SAMPLE / "test").glob("*.exr"))
            self.assertEqual(sorted(os.listdir(out)), [scene.name for scene in scenes])
            for path in scenes:
                scene, clean = ExrFile(path), ExrFile(Path(out) / path.name)
                self.assertEqual(sorted(clean.channels), ["B", "G", "R"])
                reference = scene.planes(["ref.R", "ref.G", "ref.B"]).astype(np.float64)
                error = lambda c: ((c - reference) ** 2 / (reference**2 + 0.001)).sum(0).mean()
                scores.append((error(scene.planes("RGB")), error(clean.planes("RGB"))))
        return scores

    def test_open_image_denoise_removes_most_of_the_error(self) -> None:
        for noisy, clean in self.relmse("oidn"):
            self.assertLess(clean, 0.1 * noisy)

    def test_features_help_and_a_reference_needs_none(self) -> None:
        clean = lambda denoiser: sum(clean for _, clean in self.relmse(denoiser))
        reference, prefilter, features, color = map(clean, ["oidn-reference", "oidn-prefilter", "oidn", "oidn-color"])
        self.assertLess(reference, 0.5 * features)
        self.assertNotAlmostEqual(prefilter / features, 1, places=2)
        self.assertLess(prefilter, color)
        self.assertLess(features, color)

    def test_non_local_means_removes_some_of_the_error(self) -> None:
        for noisy, clean in self.relmse("nlm"):
            self.assertLess(clean, 0.9 * noisy)

    def test_a_directory_without_manifest_is_one_line(self) -> None:
        with tempfile.TemporaryDirectory() as empty:
            ended = run("baselines", "nlm", "--data", empty, "-o", empty)
        self.assertEqual(ended.returncode, 1)
        self.assertEqual(ended.stderr.count("\n"), 1, ended.stderr)
        self.assertTrue(ended.stderr.startswith("error: "))


class References(Tools):
    def test_only_training_references_change_and_they_are_cleaner(self) -> None:
        import numpy as np
        from dataset import manifest
        from demc.torch.exr import ExrFile
        from references import noise

        names = ["ref.R", "ref.G", "ref.B"]
        with tempfile.TemporaryDirectory() as out:
            for _ in range(2):
                ended = run("references", "--data", SAMPLE, "-o", out)
                self.assertEqual(ended.returncode, 0, ended.stderr)
            before, after = manifest(SAMPLE)["scenes"], manifest(Path(out))["scenes"]
            self.assertEqual([scene["name"] for scene in before], [scene["name"] for scene in after])
            for old, new in zip(before, after):
                was, now = ExrFile(SAMPLE / old["file"]), ExrFile(Path(out) / new["file"])
                if old["split"] != "train":
                    self.assertTrue(os.path.samefile(was.path, now.path))
                    continue
                self.assertEqual(was.parts[0].header["demc"], now.parts[0].header["demc"])
                self.assertEqual(list(was.channels), list(now.channels))
                for name in was.channels:
                    self.assertEqual(was.channels[name].pixels.dtype, now.channels[name].pixels.dtype)
                    if name not in names:
                        np.testing.assert_array_equal(was.channels[name].pixels, now.channels[name].pixels)
                raw, clean = was.planes(names).clip(0), now.planes(names)
                level = lambda image: float(noise(np.log(image + 0.02).mean(0)).mean())
                self.assertLess(level(clean), level(raw))
                self.assertLess(abs(clean.mean() / raw.mean() - 1), 0.02)

    def test_black_samples_stay_dark(self) -> None:
        import numpy as np
        from references import clean

        # One-pixel bars in front of a window. Open Image Denoise alone brightens them.
        flat = np.full((64, 64, 3), 0.5, np.float32)
        window = np.where((np.arange(64) % 8 == 3)[None, :, None], 0, 4 * flat)
        self.assertLess(clean(window, flat, flat)[:, 3::8].max(), 0.002)

    def test_shards_make_the_files_of_one_run(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            whole, shared = Path(folder) / "whole", Path(folder) / "shared"
            self.assertEqual(run("references", "--data", SAMPLE, "-o", whole).returncode, 0)
            for part in ("2/2", "1/2"):
                ended = run("references", "--data", SAMPLE, "-o", shared, "--shard", part)
                self.assertIn(f"references denoised; shard {part} is complete", ended.stdout)
                self.assertFalse((shared / "manifest.json").exists())
            ended = run("references", "--data", SAMPLE, "-o", shared)
            self.assertIn("0 references denoised", ended.stdout)
            files = lambda out: {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}
            self.assertEqual(files(whole), files(shared))

    def test_guides_come_from_the_references_samples_if_present(self) -> None:
        import numpy as np
        from dataset import albedo, manifest
        from demc.torch.exr import read_exr
        from oidn import prefiltered
        from references import guide

        frame = read_exr(SAMPLE / manifest(SAMPLE)["scenes"][0]["file"])
        noisy = albedo(frame)
        np.testing.assert_array_equal(guide(frame, "texture1", noisy), noisy)
        grey = replace(frame.file.channels["ref.R"], pixels=np.full(noisy.shape[:2], 0.25, np.float32))
        frame.file.channels |= {f"ref.albedo1.{name}": grey for name in "RGB"}
        np.testing.assert_array_equal(guide(frame, "texture1", noisy), np.full_like(noisy, 0.25))
        # The noise halves, and the albedo below it stays.
        noise = np.random.default_rng(1).normal(0, 0.1, noisy.shape).astype(np.float32)
        after = prefiltered("albedo", (noisy + noise).clip(0, 1)) - noisy
        self.assertLess(np.abs(after).mean(), 0.5 * np.abs(noise).mean())

    def test_a_data_set_is_not_overwritten(self) -> None:
        ended = run("references", "--data", SAMPLE, "-o", SAMPLE)
        self.assertEqual((ended.returncode, ended.stderr.count("\n")), (1, 1), ended.stderr)


class OtherRenderers(Tools):
    """Both tools on a data set with files that Cycles wrote."""

    def setUp(self) -> None:
        super().setUp()
        import OpenEXR
        from demc.torch.exr import ExrFile

        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.data, self.out = Path(directory.name) / "data", Path(directory.name) / "out"
        self.data.mkdir()
        noisy = OpenEXR.File(str(RENDERERS / "cycles-5.0.exr"), separate_channels=True).parts
        clean = ExrFile(RENDERERS / "cycles-reference.exr")
        planes = {name: clean.channels[f"ViewLayer.Combined.{name}"].pixels for name in "RGB"}
        reference = OpenEXR.Part({"type": OpenEXR.scanlineimage}, planes, "ref")
        OpenEXR.File([*noisy, reference]).write(str(self.data / "cycles.exr"))
        scene = {"name": "cycles", "base": "cycles", "file": "cycles.exr", "width": 64, "height": 64}
        scenes = [scene | {"split": "train"}, scene | {"split": "test", "name": "cycles-test"}]
        (self.data / "manifest.json").write_text(json.dumps({"format": "demc-exr 1", "scenes": scenes}))

    def error(self, tool: str, *arguments: object) -> str:
        ended = run(tool, *arguments, "--data", self.data, "-o", self.out)
        self.assertEqual((ended.returncode, ended.stderr.count("\n")), (1, 1), ended.stderr)
        return ended.stderr

    def test_references_keep_all_parts_and_channels(self) -> None:
        from demc.torch.exr import ExrFile

        ended = run("references", "--data", self.data, "-o", self.out)
        self.assertEqual(ended.returncode, 0, ended.stderr)
        was, now = ExrFile(self.data / "cycles.exr"), ExrFile(self.out / "train" / "cycles.exr")
        self.assertEqual(list(was.channels), list(now.channels))
        self.assertEqual([part.name() for part in was.parts], [part.name() for part in now.parts])
        same = {name for name in was.channels if (was.channels[name].pixels == now.channels[name].pixels).all()}
        self.assertEqual(set(was.channels) - same, {"ref.R", "ref.G", "ref.B"})

    @unittest.skipIf(importlib.util.find_spec("torch") is None, "no torch")
    def test_an_albedo_filter_denoises_the_albedo(self) -> None:
        import demc.torch
        import numpy as np
        from demc.torch.exr import ExrFile, read_exr

        model = ROOT / "models" / "quality.safetensors"
        ended = run("references", "--data", self.data, "-o", self.out, "--albedo-filter", model)
        self.assertEqual(ended.returncode, 0, ended.stderr)
        was, now = ExrFile(self.data / "cycles.exr"), ExrFile(self.out / "train" / "cycles.exr")
        same = {name for name in was.channels if (was.channels[name].pixels == now.channels[name].pixels).all()}
        albedo = {f"ViewLayer.Denoising Albedo.{name}" for name in "RGB"}
        self.assertEqual(set(was.channels) - same, {"ref.R", "ref.G", "ref.B"} | albedo)
        before = read_exr(self.data / "cycles.exr", None, None)
        expected = demc.torch.load(model).filtered_albedo(before.color, before.features)
        np.testing.assert_allclose(read_exr(self.out / "train" / "cycles.exr", None, None).features[6:9], expected, atol=1e-3)

    def test_baselines_denoise_and_take_a_layer(self) -> None:
        from demc.torch.exr import ExrFile

        for layer in ([], ["--layer", "ViewLayer"], ["--layout", "cycles"]):
            ended = run("baselines", "oidn", "--data", self.data, "-o", self.out, *layer)
            self.assertEqual(ended.returncode, 0, ended.stderr)
        truth = ExrFile(self.data / "cycles.exr").planes(["ref.R", "ref.G", "ref.B"])
        noisy = ExrFile(self.data / "cycles.exr").planes([f"ViewLayer.Combined.{name}" for name in "RGB"])
        clean = ExrFile(self.out / "cycles.exr").planes("RGB")
        error = lambda image: ((image - truth) ** 2 / (truth**2 + 0.001)).mean()
        self.assertLess(error(clean), 0.5 * error(noisy))

    def test_a_mistake_is_one_line(self) -> None:
        layout = self.data / "mine.toml"
        layout.write_text('color = ["R", "G", "R"]\n[missing]\nnormal = "zeros"\n')
        for tool in (["references"], ["baselines", "nlm"]):
            self.assertIn("neither a preset (demc-exr, ", self.error(*tool, "--layout", "cycle"))
            self.assertIn('channel "R" is named twice', self.error(*tool, "--layout", layout))
            self.assertIn('no view layer "Glass"; there is ViewLayer', self.error(*tool, "--layer", "Glass"))

    def test_denoisers_without_features_need_the_colour_only(self) -> None:
        import numpy as np
        from dataset import write

        write(self.data / "cycles.exr", {name: np.full((64, 64), 0.5, np.float32) for name in "RGB"})
        ended = run("baselines", "oidn-color", "--data", self.data, "-o", self.out)
        self.assertEqual(ended.returncode, 0, ended.stderr)
        self.assertIn("lacks normal.X, normal.Y, normal.Z", self.error("baselines", "oidn"))
        self.assertIn("no reference channels", self.error("baselines", "oidn-reference", "--layout", self.bare()))

    def bare(self) -> Path:
        layout = self.data / "bare.toml"
        layout.write_text('color = ["R", "G", "B"]\nmissing = {normal="zeros", position="zeros", texture1="zeros", texture2="zeros"}')
        return layout


if __name__ == "__main__":
    unittest.main()
