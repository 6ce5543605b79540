"""The bundled model `fast` at 1 to 256 samples per pixel: a denoised image is never worse than the noisy one.

Two rooms and a still life of kinds that training never draws are rendered and scored with the built
`demc-infer`. Skipped without mitsuba, numpy, or OpenEXR, unless DEMC_REQUIRE_MITSUBA=1.
"""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MISSING = [name for name in ("numpy", "OpenEXR", "mitsuba") if importlib.util.find_spec(name) is None]
COUNTS = (1, 4, 16, 64, 256)
SCENES = ("--rooms", 2, "--stills", 1, "--views", 1, "--reserved", "--split", "test", "--seed", 8, "--size", 96)


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_MITSUBA") != "1", f"no {', '.join(MISSING)}")
class SampleCounts(unittest.TestCase):
    def test_a_denoised_image_is_never_worse_than_the_noisy_one(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            counts = ",".join(map(str, COUNTS))
            render = [sys.executable, ROOT / "python" / "render", "-o", folder, *SCENES, "--spp", counts, "--ref-spp", 1024, "--residual", 0]
            subprocess.run([*map(str, render)], check=True, capture_output=True)
            scenes = {scene["name"]: scene["spp"] for scene in json.loads(Path(folder, "manifest.json").read_text())["scenes"]}
            self.assertEqual(len(scenes), 3 * len(COUNTS))
            program = ROOT / "target" / "release" / "demc-infer"
            evaluate = [program, "evaluate", "--model", "fast", "--data", folder, "--json", "-"]
            scores = subprocess.run([*map(str, evaluate)], check=True, capture_output=True, text=True)
            for image in json.loads(scores.stdout)["images"]:
                with self.subTest(scene=image["name"], spp=scenes[image["name"]]):
                    self.assertLess(image["denoised"]["relmse"], image["noisy"]["relmse"])
                    self.assertGreater(image["denoised"]["ssim"], image["noisy"]["ssim"])


if __name__ == "__main__":
    unittest.main()
