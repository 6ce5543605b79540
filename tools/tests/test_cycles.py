"""Tests of `cycles/`. They are skipped without bpy or OpenEXR, unless DEMC_REQUIRE_BPY=1."""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "cycles"
MISSING = [name for name in ("bpy", "OpenEXR") if importlib.util.find_spec(name) is None]
SMALL = ("--views", 1, "--size", 48, "--ref-spp", 32, "--residual", 1)


def run(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, FOLDER, *map(str, arguments)], capture_output=True, text=True)


def manifest(folder: object) -> dict:
    return json.loads(Path(folder, "manifest.json").read_text())


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_BPY") != "1", f"no {', '.join(MISSING)}")
class Cycles(unittest.TestCase):
    def test_every_kind_of_both_editions_is_rendered(self) -> None:
        import numpy as np
        import OpenEXR

        for edition, relit in (("train", 1), ("heldout", 0)):
            for kind in ("things", "volume", "fur", "motion"):
                with self.subTest(kind, edition=edition), tempfile.TemporaryDirectory() as folder:
                    ended = run("-o", folder, "--scenes", 2, *SMALL, "--kind", kind, "--edition", edition, "--relit", relit, "--spp", "1,8")
                    self.assertEqual(ended.returncode, 0, ended.stderr)
                    listed = manifest(folder)
                    self.assertEqual(len(listed["scenes"]) / 2 + len(listed["left_out"]), 2)
                    self.assertTrue(listed["scenes"], ended.stdout)
                    errors, references = {1: 0.0, 8: 0.0}, {}
                    for scene in listed["scenes"]:
                        self.assertEqual((scene["kind"], scene["width"]), (kind, 48))
                        with OpenEXR.File(str(Path(folder, scene["file"])), separate_channels=True) as file:
                            planes = {name: channel.pixels.astype(float) for name, channel in file.channels().items()}
                        luminance = sum(weight * planes[f"ref.{name}"] for name, weight in zip("RGB", (0.2126, 0.7152, 0.0722)))
                        # As `rendered.brightness` scales it; the probe has other samples.
                        self.assertAlmostEqual(np.sort(luminance.ravel())[: int(0.98 * luminance.size)].mean(), 0.22, delta=0.08)
                        # Without bright dots, which few samples rarely find.
                        errors[scene["spp"]] += np.minimum(abs(planes["G"] - planes["ref.G"]), 0.2).mean()
                        references.setdefault(scene["base"], []).append(np.stack([planes[f"ref.{name}"] for name in "RGB"]))
                    self.assertLess(errors[8], errors[1])
                    for one, other in references.values():
                        self.assertEqual(abs(one - other).max() > 0.01, bool(relit))

    def test_motion_blurs_what_moves(self) -> None:
        code = """
import sys
sys.path[:0] = sys.argv[1:3]
import numpy as np, scenes, shot
stage = scenes.build(3, 0, "motion", "train")
stage.camera(np.random.default_rng(0))
shot.prepare(stage.scene, 64, shot.Settings("BOX", 0.0))
moving = shot.trace(stage.scene, 32, 1)["normal"]
stage.scene.render.use_motion_blur = False
still, again = (shot.trace(stage.scene, 32, seed)["normal"] for seed in (1, 2))
print(np.abs(moving - still).mean(), np.abs(again - still).mean())
"""
        ended = subprocess.run([sys.executable, "-c", code, FOLDER, FOLDER.parent], capture_output=True, text=True)
        self.assertEqual(ended.returncode, 0, ended.stderr)
        blur, noise = map(float, ended.stdout.split())
        self.assertGreater(blur, 2 * noise)

    def test_the_groups_of_lights_add_up_to_the_image(self) -> None:
        code = """
import sys
sys.path[:0] = sys.argv[1:3]
import numpy as np, scenes, shot
for index in range(3):
    stage = scenes.build(6929, index, "things", "heldout")
    stage.camera(np.random.default_rng(0))
    shot.prepare(stage.scene, 32, shot.Settings("BOX", 0.0))
    stage.group(np.random.default_rng(1))
    stage.scene.cycles.samples = 4
    planes = shot.passes(stage.scene)
    groups = sum(planes[f"ViewLayer.Combined_{group}.G"] for group in shot.GROUPS)
    print(np.abs(groups - planes["ViewLayer.Combined.G"]).max(), groups.mean())
"""
        ended = subprocess.run([sys.executable, "-c", code, FOLDER, FOLDER.parent], capture_output=True, text=True)
        self.assertEqual(ended.returncode, 0, ended.stderr)
        self.assertEqual(len(ended.stdout.splitlines()), 3)
        for line in ended.stdout.splitlines():
            difference, mean = map(float, line.split())
            self.assertLess(difference, 1e-5)
            self.assertGreater(mean, 0.01)

    def test_shards_make_the_data_set_of_one_run_and_resume(self) -> None:
        import numpy as np
        import OpenEXR

        def planes(path: Path) -> np.ndarray:
            with OpenEXR.File(str(path)) as file:
                return np.concatenate([np.atleast_3d(channel.pixels).astype(float) for channel in file.channels().values()], -1)

        with tempfile.TemporaryDirectory() as folder:
            whole, parts = Path(folder, "whole"), Path(folder, "parts")
            ask = ("--scenes", 3, *SMALL, "--kind", "fur")
            for out, more in ((whole, ()), (parts, ("--shard", "1/2")), (parts, ("--shard", "2/2")), (parts, ())):
                ended = run("-o", out, *ask, *more)
                self.assertEqual(ended.returncode, 0, ended.stderr)
            scenes = manifest(whole)["scenes"]
            facts = lambda listed: [[scene[key] for key in ("name", "kind", "spp", "ref_spp", "seed", "pixel_filter")] for scene in listed]
            self.assertEqual(facts(scenes), facts(manifest(parts)["scenes"]))
            self.assertTrue(scenes)
            again = run("-o", whole, *ask)
            self.assertEqual((again.returncode, again.stdout), (0, ""), again.stderr)
            for scene in scenes:
                one, other = (planes(out / scene["file"]) for out in (whole, parts))
                # Half floats round sums of another order to a neighbour.
                self.assertGreater(np.isclose(one, other, rtol=2e-3, atol=1e-3).mean(), 0.98)

    def test_a_folder_that_cannot_be_made_is_one_line(self) -> None:
        with tempfile.NamedTemporaryFile() as file:
            ended = run("-o", f"{file.name}/data", "--scenes", 1)
        self.assertEqual((ended.returncode, ended.stderr.count("\n")), (1, 1), ended.stderr)
        self.assertIn("error: ", ended.stderr)


if __name__ == "__main__":
    unittest.main()
