"""Tests of `render/` and of the bundled models at several numbers of samples per pixel.

Skipped without mitsuba, numpy, or OpenEXR, unless DEMC_REQUIRE_MITSUBA=1.
"""

import json
import os
import subprocess
import tempfile
import unittest
from pathlib import Path

from test_render import MISSING, run

ROOT = Path(__file__).resolve().parents[2]
COUNTS = (1, 4, 16, 64, 256)
SCENES = ("--rooms", 2, "--stills", 1, "--views", 1, "--edition", "heldout", "--split", "test", "--seed", 8, "--size", 96)


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_MITSUBA") != "1", f"no {', '.join(MISSING)}")
class SampleCounts(unittest.TestCase):
    def test_an_image_of_more_samples_contains_those_of_fewer(self) -> None:
        import numpy as np
        import OpenEXR

        def planes(path: Path, prefix: str) -> np.ndarray:
            with OpenEXR.File(str(path), separate_channels=True) as file:
                return np.stack([file.channels()[prefix + name].pixels.astype(float) for name in "RGB"])

        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder)
            ask = ("--stills", 1, "--views", 1, "--size", 32, "--ref-spp", 64)
            ended = run("-o", out, *ask, "--spp", "16,1")
            self.assertEqual(ended.returncode, 0, ended.stderr)
            few, many = json.loads((out / "manifest.json").read_text())["scenes"]
            few, many = sorted((few, many), key=lambda scene: scene["spp"])
            self.assertEqual((few["spp"], many["spp"], few["base"]), (1, 16, many["base"]))
            self.assertEqual([scene["name"][-5:] for scene in (few, many)], ["-1spp", "16spp"])
            self.assertLess(many["noisy_relmse"], few["noisy_relmse"])
            self.assertGreaterEqual(many["ref_spp"], 64)
            np.testing.assert_array_equal(planes(out / few["file"], "ref."), planes(out / many["file"], "ref."))
            difference = planes(out / few["file"], "") - planes(out / many["file"], "")
            noise = planes(out / few["file"], "") - planes(out / few["file"], "ref.")
            self.assertLess((difference**2).mean(), (noise**2).mean())

    def test_wrong_counts_are_an_error(self) -> None:
        for counts in ("0", "1,x", "", "-4"):
            with tempfile.TemporaryDirectory() as empty:
                ended = run("-o", empty, "--rooms", 1, f"--spp={counts}")
            self.assertEqual(ended.returncode, 2)
            self.assertIn("argument --spp", ended.stderr)

    def test_a_denoised_image_is_never_worse_than_the_noisy_one(self) -> None:
        """Two rooms and a still life of kinds that training never draws, scored with the built `demc-infer`."""
        with tempfile.TemporaryDirectory() as folder:
            counts = ",".join(map(str, COUNTS))
            ended = run("-o", folder, *SCENES, "--spp", counts, "--ref-spp", 1024, "--residual", 0)
            self.assertEqual(ended.returncode, 0, ended.stderr)
            scenes = {scene["name"]: scene["spp"] for scene in json.loads(Path(folder, "manifest.json").read_text())["scenes"]}
            self.assertEqual(len(scenes), 3 * len(COUNTS))
            program = ROOT / "target" / "release" / "demc-infer"
            for model in ("quality", "fast"):
                evaluate = [program, "evaluate", "--model", model, "--data", folder, "--json", "-"]
                scores = subprocess.run([*map(str, evaluate)], check=True, capture_output=True, text=True)
                for image in json.loads(scores.stdout)["images"]:
                    with self.subTest(model=model, scene=image["name"], spp=scenes[image["name"]]):
                        self.assertLess(image["denoised"]["relmse"], image["noisy"]["relmse"])
                        self.assertGreater(image["denoised"]["ssim"], image["noisy"]["ssim"])


if __name__ == "__main__":
    unittest.main()
