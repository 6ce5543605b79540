"""`tools/baselines.py` on the repository's sample: `python -m unittest discover -s tests`, in `python/`.

Skipped without what the tool needs (numpy, OpenEXR, pyoidn, scikit-image, PyWavelets), unless DEMC_REQUIRE_BASELINES=1.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOOL = ROOT / "python" / "tools" / "baselines.py"
SAMPLE = ROOT / "data" / "sample"
NEEDED = ["numpy", "OpenEXR", "pyoidn", "skimage", "pywt"]
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]


def run(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, TOOL, *map(str, arguments)], capture_output=True, text=True)


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_BASELINES") != "1", f"no {', '.join(MISSING)}")
class Baselines(unittest.TestCase):
    def relmse(self, denoiser: str) -> list[tuple[float, float]]:
        """RelMSE of the noisy and of the denoised image, by scene."""
        import numpy as np

        sys.path.insert(0, str(TOOL.parent))
        self.addCleanup(sys.path.remove, str(TOOL.parent))
        from baselines import Scene

        scores = []
        with tempfile.TemporaryDirectory() as out:
            ended = run(denoiser, "--data", SAMPLE, "-o", out)
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

    def test_open_image_denoise_takes_most_of_the_error_away(self) -> None:
        for noisy, clean in self.relmse("oidn"):
            self.assertLess(clean, 0.1 * noisy)

    def test_features_help_and_a_reference_needs_none(self) -> None:
        clean = lambda denoiser: sum(clean for _, clean in self.relmse(denoiser))
        reference, features, color = map(clean, ["oidn-reference", "oidn", "oidn-color"])
        self.assertLess(reference, 0.5 * features)
        self.assertLess(features, color)

    def test_non_local_means_takes_some_of_the_error_away(self) -> None:
        for noisy, clean in self.relmse("nlm"):
            self.assertLess(clean, 0.9 * noisy)

    def test_a_directory_without_manifest_is_one_line(self) -> None:
        with tempfile.TemporaryDirectory() as empty:
            ended = run("nlm", "--data", empty, "-o", empty)
        self.assertEqual(ended.returncode, 1)
        self.assertEqual(ended.stderr.count("\n"), 1, ended.stderr)
        self.assertTrue(ended.stderr.startswith("error: "))


if __name__ == "__main__":
    unittest.main()
