"""Tests of `tools/baselines.py` and `tools/references.py` on data/sample.

Run `python -m unittest discover -s tests` in `python/`. The tests are skipped without the tools'
packages (numpy, OpenEXR, pyoidn, scikit-image, PyWavelets), unless DEMC_REQUIRE_BASELINES=1.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ROOT / "python" / "tools"
SAMPLE = ROOT / "data" / "sample"
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
        from dataset import Scene

        scores = []
        with tempfile.TemporaryDirectory() as out:
            ended = run("baselines", denoiser, "--data", SAMPLE, "-o", out)
            self.assertEqual(ended.returncode, 0, ended.stderr)
            scenes = sorted((SAMPLE / "test").glob("*.exr"))
            self.assertEqual(sorted(os.listdir(out)), [scene.name for scene in scenes])
            for path in scenes:
                scene, clean = Scene(path), Scene(Path(out) / path.name)
                self.assertEqual(sorted(clean.channels), ["B", "G", "R"])
                reference = scene.rgb("ref.").astype(np.float64)
                error = lambda c: ((c - reference) ** 2 / (reference**2 + 0.001)).sum(-1).mean()
                scores.append((error(scene.rgb("")), error(clean.rgb(""))))
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
        from dataset import Scene, manifest
        from references import noise

        with tempfile.TemporaryDirectory() as out:
            for _ in range(2):
                ended = run("references", "--data", SAMPLE, "-o", out)
                self.assertEqual(ended.returncode, 0, ended.stderr)
            before, after = manifest(SAMPLE)["scenes"], manifest(Path(out))["scenes"]
            self.assertEqual([scene["name"] for scene in before], [scene["name"] for scene in after])
            for old, new in zip(before, after):
                was, now = Scene(SAMPLE / old["file"]), Scene(Path(out) / new["file"])
                if old["split"] != "train":
                    self.assertTrue(os.path.samefile(was.path, now.path))
                    continue
                self.assertEqual(was.about, now.about)
                self.assertEqual(list(was.channels), list(now.channels))
                for name in was.channels:
                    self.assertEqual(was.channels[name].dtype, now.channels[name].dtype)
                    if not name.startswith("ref."):
                        np.testing.assert_array_equal(was.channels[name], now.channels[name])
                raw, clean = was.rgb("ref.").clip(0), now.rgb("ref.")
                level = lambda image: float(noise(np.log(image + 0.02).mean(-1)).mean())
                self.assertLess(level(clean), level(raw))
                self.assertLess(abs(clean.mean() / raw.mean() - 1), 0.02)

    def test_black_samples_stay_dark(self) -> None:
        import numpy as np
        from references import clean

        # One-pixel bars in front of a window. Open Image Denoise alone brightens them.
        flat = np.full((64, 64, 3), 0.5, np.float32)
        window = np.where((np.arange(64) % 8 == 3)[None, :, None], 0, 4 * flat)
        self.assertLess(clean(window, flat, flat)[:, 3::8].max(), 0.002)

    def test_guides_come_from_the_references_samples_if_present(self) -> None:
        import numpy as np
        from dataset import Scene, manifest
        from oidn import prefiltered
        from references import guide

        scene = Scene(SAMPLE / manifest(SAMPLE)["scenes"][0]["file"])
        albedo = guide(scene, "albedo1.", "RGB")
        np.testing.assert_array_equal(albedo, scene.rgb("albedo1."))
        scene.channels |= {f"ref.albedo1.{name}": np.full_like(scene.channels["ref.R"], 0.25) for name in "RGB"}
        np.testing.assert_array_equal(guide(scene, "albedo1.", "RGB"), np.full_like(albedo, 0.25))
        # The noise halves, and the albedo below it stays.
        noise = np.random.default_rng(1).normal(0, 0.1, albedo.shape).astype(np.float32)
        after = prefiltered("albedo", (albedo + noise).clip(0, 1)) - albedo
        self.assertLess(np.abs(after).mean(), 0.5 * np.abs(noise).mean())

    def test_a_data_set_is_not_overwritten(self) -> None:
        ended = run("references", "--data", SAMPLE, "-o", SAMPLE)
        self.assertEqual((ended.returncode, ended.stderr.count("\n")), (1, 1), ended.stderr)


if __name__ == "__main__":
    unittest.main()
