"""Tests of `render/` against Mitsuba's own integrators.

They are skipped without mitsuba, numpy, or OpenEXR, unless DEMC_REQUIRE_MITSUBA=1.
"""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "render"
MISSING = [name for name in ("numpy", "OpenEXR", "mitsuba") if importlib.util.find_spec(name) is None]
SIDE, SAMPLES = 32, 1024
SHARED = {
    *("Stage.__init__", "Stage.tint", "Stage.paint", "Stage.material", "Stage.any_material", "color", "noise", "tiled"),
    *("Stage.add", "Stage.box", "Stage.rod", "Stage.ball", "Stage.turned", "Stage.mesh", "environment", "square_film"),
    *("matt", "rgb"),
    *("Room.__init__", "Room.shell", "Room.ceiling", "Room.pictures", "Room.furnish", "Room.blacken", "Room.camera"),
    *("Still.__init__", "Still.ground", "Still.surface", "Still.arrange", "Still.darken", "Still.camera"),
}
"""What draws training scenes, the scenes of the held-out set, and those of the comparison."""


def run(*arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, FOLDER, *map(str, arguments)], capture_output=True, text=True)


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_MITSUBA") != "1", f"no {', '.join(MISSING)}")
class Render(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        for folder in (FOLDER.parent, FOLDER):
            sys.path.insert(0, str(folder))
            cls.addClassCleanup(sys.path.remove, str(folder))

    def scene(self) -> dict:
        """A box with a light, a plastic wall, and a metal ball."""
        from variant import mi

        scene = mi.cornell_box()
        film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        scene["sensor"]["film"] = film | {"component_format": "float32"}
        scene["back"]["bsdf"] = {"type": "roughplastic", "diffuse_reflectance": {"type": "rgb", "value": [0.3, 0.5, 0.1]}}
        ball = {"type": "sphere", "center": [0.4, -0.5, 0.5], "radius": 0.3, "bsdf": {"type": "roughconductor", "material": "Cu"}}
        return scene | {"ball": ball}

    def test_a_folder_that_cannot_be_made_is_one_line(self) -> None:
        with tempfile.NamedTemporaryFile() as file:
            ended = run("-o", f"{file.name}/data", "--stills", 1)
        self.assertEqual((ended.returncode, ended.stderr.count("\n")), (1, 1), ended.stderr)
        self.assertIn("error: ", ended.stderr)

    def test_radiance_is_that_of_mitsubas_path_integrator(self) -> None:
        import numpy as np
        import tracer
        from variant import mi

        scene = mi.load_dict(self.scene())
        path = mi.load_dict({"type": "path", "max_depth": tracer.MAX_DEPTH, "rr_depth": 100})
        theirs = np.array(mi.render(scene, integrator=path, spp=SAMPLES, seed=7))
        halves = [tracer.render(scene, SAMPLES // 2, seed) for seed in (1000, 2000)]
        a, b = (half.color / half.count for half in halves)
        ours, noise = (a + b) / 2, np.abs(a - b).mean() / 2
        np.testing.assert_allclose(ours.mean((0, 1)), theirs.mean((0, 1)), rtol=0.01)
        # The difference of two equally noisy images has sqrt(2) of the noise of one.
        self.assertLess(np.abs(ours - theirs).mean(), 2 * noise)

    def test_passes_add_up_and_variances_are_those_of_repeated_renders(self) -> None:
        import numpy as np
        import tracer
        from variant import mi

        scene = mi.load_dict(self.scene())
        # A few bright samples decide the mean variance: 16 runs differ from it by up to a fifth.
        plain = tracer.render(scene, 32, 1000, clamp=2)
        runs = [tracer.render(scene, 32, 1000 + 100 * i, clamp=2, passes=True) for i in range(16)]
        np.testing.assert_array_equal(plain.color, runs[0].color)
        for run in runs:
            np.testing.assert_allclose(run.mean("diffuse") + run.mean("specular"), run.mean("color"), atol=1e-5)
        for name in tracer.VARIANCES:
            means = np.stack([run.mean(name) for run in runs])
            variances = np.stack([run.variance(name) for run in runs])
            np.testing.assert_allclose(means.var(0, ddof=1).mean(), variances.mean(), rtol=0.35, err_msg=name)
        diffuse, specular = (np.mean([run.mean(name) for run in runs], 0) for name in ("diffuse", "specular"))
        wall = np.s_[8:24, 1:4]
        self.assertEqual(specular[wall].max(), 0)
        # The plastic wall has both lobes, the metal ball one.
        plastic = np.s_[4:10, 10:22]
        self.assertGreater(diffuse[plastic].mean(), 0.01)
        self.assertGreater(specular[plastic].mean(), 1e-4)
        depth = runs[0].mean("depth")
        self.assertTrue(3 < depth[16, 16, 0] < 5.5, depth[16, 16])

    def test_passes_are_written(self) -> None:
        import OpenEXR

        with tempfile.TemporaryDirectory() as folder:
            small = ("--rooms", 1, "--views", 1, "--size", 64, "--spp", "4,8", "--ref-spp", 32, "--residual", 1)
            done = run("-o", folder, *small, "--passes", "paper")
            self.assertEqual(done.returncode, 0, done.stderr)
            found = sorted(Path(folder).glob("train/*.exr"))
            self.assertEqual(len(found), 2, done.stdout)
            for path in found:
                with OpenEXR.File(str(path), separate_channels=True) as file:
                    planes = {name: channel.pixels.astype(float) for name, channel in file.channels().items()}
                for name in ("R", "normal.X", "albedo1.G", "depth.Z"):
                    mean = (planes[f"half1.{name}"] + planes[f"half2.{name}"]) / 2
                    self.assertLess(abs(mean - planes[name]).mean(), 0.002 * abs(planes[name]).mean())
                    self.assertGreater(planes[f"variance.{name}"].max(), 0)
                for start in ("", "ref."):
                    parts = planes[start + "diffuse.R"] + planes[start + "specular.R"]
                    self.assertLess(abs(parts - planes[start + "R"]).mean(), 0.002)
            odd = run("-o", folder, *small, "--passes", "paper", "--spp", "1,4")
            self.assertEqual(odd.returncode, 2)
            self.assertIn("even numbers of --spp", odd.stderr)

    def test_features_are_those_of_mitsubas_aov_integrator(self) -> None:
        import numpy as np
        import tracer
        from variant import mi

        scene = mi.load_dict(self.scene())
        aovs = {"type": "aov", "aovs": "a:albedo,n:sh_normal,p:position"}
        theirs = np.array(mi.render(scene, integrator=mi.load_dict(aovs), spp=SAMPLES, seed=7))
        ours = tracer.render(scene, SAMPLES, 1000)
        albedo, normal, position = (ours.features[name] / ours.count for name in ("albedo1", "normal", "position"))
        np.testing.assert_allclose(np.abs(normal).mean((0, 1)), np.abs(theirs[..., 3:6]).mean((0, 1)), atol=0.01)
        np.testing.assert_allclose(position.mean((0, 1)), theirs[..., 6:9].mean((0, 1)), atol=0.01)
        # Mitsuba's albedo differs for visible lights, plastic, and metal; the left wall is diffuse.
        wall = np.s_[8:24, 1:4]
        np.testing.assert_allclose(albedo[wall], theirs[wall][..., :3], atol=0.02)
        # The second hit differs from the first.
        self.assertGreater(np.abs(ours.features["albedo2"] / ours.count - albedo).mean(), 0.05)

    def test_a_path_is_traced_once_for_all_channels(self) -> None:
        import drjit as dr
        import tracer
        from variant import mi

        scene = mi.load_dict(self.scene())
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            tracer.render(scene, 4, 1000)
            operations = sorted(kernel.get("operation_count", 0) for kernel in dr.kernel_history())
        self.assertGreater(operations[-1], 1000)
        self.assertLess(sum(operations[:-1]), operations[-1] / 2)

    def test_a_clamp_bounds_everything_but_visible_lights(self) -> None:
        import numpy as np
        import tracer
        from variant import mi

        scene = mi.load_dict(self.scene())
        free, bounded = (tracer.render(scene, 16, 1000, clamp) for clamp in (np.inf, 0.1))
        lit = free.features["albedo1"].min(-1) / free.count > 0.999
        self.assertGreaterEqual(lit.sum(), 4)
        # Except for light that the emitter reflects.
        np.testing.assert_allclose(bounded.color[lit], free.color[lit], rtol=0.03)
        below = np.s_[SIDE // 2 :]
        self.assertLessEqual((bounded.color[below] / free.count).max(), 0.1 + 1e-6)
        self.assertLess(bounded.color[below].mean(), 0.7 * free.color[below].mean())

    def test_the_sun_shines_in_through_a_window(self) -> None:
        import numpy as np
        from rooms import Room

        inwards = np.array([[0, 1], [-1, 0], [0, -1], [1, 0]])
        lit = 0
        for seed in range(12):
            room = Room(np.random.default_rng(seed))
            room.sun(np.random.default_rng([seed, 1]))
            self.assertEqual("sun" in room.scene, bool(room.open_sides))
            if room.open_sides:
                direction = np.array(room.scene["sun"]["direction"])
                across = direction[:2] / np.linalg.norm(direction[:2])
                self.assertGreater((inwards[room.open_sides] @ across).max(), np.cos(np.radians(55.1)))
                self.assertLess(direction[2], 0)
                lit += 1
        self.assertGreater(lit, 4)

    def test_only_bars_and_blinds_become_black(self) -> None:
        import numpy as np
        from rooms import Room

        seeds = (seed for seed in range(50) if Room(np.random.default_rng(seed)).frames)
        room = Room(np.random.default_rng(next(seeds)))
        before = {name: shape["bsdf"] for name, shape in room.scene.items() if isinstance(shape, dict) and "bsdf" in shape}
        room.blacken(np.random.default_rng(1))
        changed = [name for name, bsdf in before.items() if room.scene[name]["bsdf"] is not bsdf]
        self.assertTrue(changed)
        self.assertLess(len(changed), len(before))
        for name in changed:
            self.assertTrue(any(before[name] is frame for frame in room.frames))
            self.assertLess(room.scene[name]["bsdf"]["bsdf"]["reflectance"]["value"], 0.02)

    def test_a_grain_changes_paint_and_nothing_else(self) -> None:
        import numpy as np
        from rooms import Room

        def textures(value) -> list:
            """Bitmaps and colours of a scene, in order."""
            if not isinstance(value, dict):
                return []
            if value.get("type") in ("bitmap", "rgb"):
                return [value]
            return [found for inner in value.values() for found in textures(inner)]

        plain, grained = (Room(np.random.default_rng(3), share, np.random.default_rng(9)) for share in (0.0, 1.0))
        self.assertEqual(list(plain.scene), list(grained.scene))
        shapes = [(room.scene[name]["type"], str(room.scene[name].get("to_world"))) for name in plain.scene if name != "type" for room in (plain, grained)]
        self.assertEqual(shapes[::2], shapes[1::2])
        kinds = [[texture["type"] for texture in textures(room.scene)] for room in (plain, grained)]
        self.assertGreater(kinds[1].count("bitmap"), kinds[0].count("bitmap"))

    def test_a_turned_surface_is_closed_and_faces_outwards(self) -> None:
        import mitsuba as mi
        import numpy as np
        import stage
        import stills

        still = stills.Still(np.random.default_rng(1))
        place = mi.ScalarTransform4f().translate([1, 2, 0]).rotate([0, 0, 1], 30)
        still.turned(np.array([0, 0.1, 0.1, 0]), np.array([0, 0, 0.3, 0.3]), place)
        *_, mesh = still.scene.values()
        parameters = mi.traverse(mesh)
        points = np.array(parameters["vertex_positions"]).reshape(-1, 3)
        np.testing.assert_allclose(points.min(0), [0.9, 1.9, 0], atol=1e-3)
        np.testing.assert_allclose(points.max(0), [1.1, 2.1, 0.3], atol=1e-3)
        a, b, c = points[np.array(parameters["faces"]).reshape(-1, 3).T].astype(float) - [1, 2, 0]
        # By the divergence theorem; glass needs to know which side is in.
        volume = np.einsum("ij,ij", a, np.cross(b, c)) / 6
        polygon = stage.SEGMENTS / 2 * 0.1**2 * np.sin(2 * np.pi / stage.SEGMENTS)
        self.assertAlmostEqual(volume, polygon * 0.3, places=6)

    def test_a_lens_blurs_what_is_out_of_its_focus(self) -> None:
        import mitsuba as mi
        import numpy as np
        import tracer
        from stills import Still

        lenses, between = [], []
        for seed in range(12):
            still = Still(np.random.default_rng(seed))
            camera = still.camera(np.random.default_rng(seed), SIDE)
            lenses.append(camera["type"])
            if camera["type"] == "thinlens":
                scene = mi.load_dict(still.scene | {"as it is": camera, "wide": camera | {"aperture_radius": 10 * camera["aperture_radius"]}})
                masks = (tracer.render(scene, 16, 1, view=view).features["mask"] / 16 for view in range(2))
                # Pixels that are partly covered.
                between.append([((0 < mask) & (mask < 1)).sum() for mask in masks])
        self.assertEqual(set(lenses), {"thinlens", "perspective"})
        sharp, wide = np.sum(between, axis=0)
        self.assertGreater(wide, 1.5 * sharp)

    def test_a_studio_is_black_behind_things_that_are_lit(self) -> None:
        import mitsuba as mi
        import numpy as np
        import tracer
        from stills import Still

        behind, lit = 0, []
        for seed in range(6):
            still = Still(np.random.default_rng(seed))
            still.darken(np.random.default_rng(seed))
            scene = mi.load_dict(still.scene | {"camera": still.camera(np.random.default_rng(seed), SIDE)})
            image = tracer.render(scene, 16, 1)
            # Pixels whose samples all miss have no light at all.
            missed = image.features["mask"][..., 0] == 0
            self.assertEqual(np.abs(image.color[missed]).sum(), 0)
            self.assertEqual(np.abs(image.features["albedo1"][missed]).sum(), 0)
            behind += missed.sum()
            lit.append(np.median(image.color[~missed].max(-1)) / 16)
        self.assertGreater(behind, SIDE**2 / 4)
        self.assertGreater(np.median(lit), 0.05)

    def test_each_kind_has_what_it_is_named_for(self) -> None:
        import mitsuba as mi
        import numpy as np
        import tracer
        from comparison import ComparisonStill
        from kinds import KINDS, kind_of
        from stills import Still

        words = {"glassware": "'dielectric'", "lights": "'emitter'", "foliage": "Mesh", "fine": "'cylinder'", "fur": "BSplineCurve"}
        self.assertEqual(set(words), set(KINDS))
        for kind, word in words.items():
            for edition in (Still, ComparisonStill):
                with self.subTest(kind, edition=edition):
                    found = [0, 0]
                    for seed in range(3):
                        stills = [make(np.random.default_rng(seed)) for make in (edition, kind_of(KINDS[kind], edition))]
                        for i, still in enumerate(stills):
                            shapes = (str(shape) if isinstance(shape, (dict, str)) else shape.class_name() for shape in still.scene.values())
                            found[i] += sum(shape.count(word) for shape in shapes)
                    self.assertGreater(found[1], found[0] + 2)
                    scene = mi.load_dict(still.scene | {"camera": still.camera(np.random.default_rng(4), SIDE)})
                    image = tracer.render(scene, 4, 1)
                    self.assertTrue(np.isfinite(image.color).all() and image.color.max() > 0)

    def test_a_view_of_a_kind_says_so(self) -> None:
        with tempfile.TemporaryDirectory() as out:
            ended = run("-o", out, "--stills", 2, "--views", 1, "--size", 32, "--ref-spp", 32, "--kind", "fine")
            self.assertEqual(ended.returncode, 0, ended.stderr)
            scenes = json.loads((Path(out) / "manifest.json").read_text())["scenes"]
            self.assertEqual({scene["kind"] for scene in scenes}, {"fine"})

    def test_a_data_set_depends_on_its_seed_and_resumes(self) -> None:
        for kind in ("--rooms", "--stills"):
            with self.subTest(kind):
                self.check_resume(kind)

    def check_resume(self, kind: str) -> None:
        import numpy as np
        import rendered

        with tempfile.TemporaryDirectory() as folder:
            ask = (kind, 1, "--views", 2, "--size", 32, "--ref-spp", 32)
            first, second = Path(folder) / "first", Path(folder) / "second"
            for out in (first, second):
                ended = run("-o", out, *ask)
                self.assertEqual(ended.returncode, 0, ended.stderr)
            manifest = json.loads((first / "manifest.json").read_text())
            self.assertEqual(manifest, json.loads((second / "manifest.json").read_text()))
            scenes = manifest["scenes"]
            self.assertEqual(len(scenes) + len(manifest["left_out"]), 2)
            self.assertTrue(scenes)
            for scene in scenes:
                files = [(out / scene["file"]).read_bytes() for out in (first, second)]
                self.assertEqual(*files)
                self.assertEqual(rendered.entry_of(first / scene["file"]), scene)
            again = run("-o", first, *ask, "--with", second)
            self.assertEqual((again.returncode, again.stdout), (0, ""), again.stderr)
            both = json.loads((first / "manifest.json").read_text())["scenes"]
            self.assertEqual([scene["file"] for scene in both[len(scenes) :]], [f"../second/{scene['file']}" for scene in scenes])

    def test_shards_make_the_data_set_of_one_run(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            # Of these views, one is left out.
            ask = ("--rooms", 3, "--views", 1, "--seed", 29, "--size", 32, "--ref-spp", 32)
            whole, shared = Path(folder) / "whole", Path(folder) / "shared"
            self.assertEqual(run("-o", whole, *ask).returncode, 0)
            workers = [subprocess.Popen([sys.executable, FOLDER, *map(str, ("-o", shared, *ask, "--shard", part))]) for part in ("1/3", "2/3", "3/3", "3/3")]
            self.assertEqual([worker.wait() for worker in workers], [0] * 4)
            self.assertFalse((shared / "manifest.json").exists())
            ended = run("-o", shared, *ask)
            self.assertEqual((ended.returncode, ended.stdout), (0, ""), ended.stderr)
            files = lambda out: {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}
            self.assertEqual(files(whole), files(shared))
            self.assertTrue(json.loads((whole / "manifest.json").read_text())["left_out"])

    def test_a_reference_keeps_features_of_its_own_samples(self) -> None:
        import numpy as np
        import OpenEXR

        with tempfile.TemporaryDirectory() as out:
            # With this seed the sample numbers exceed 32 bits.
            ended = run("-o", out, "--stills", 1, "--views", 2, "--size", 64, "--ref-spp", 64, "--seed", 60)
            self.assertEqual(ended.returncode, 0, ended.stderr)
            files = sorted(Path(out).glob("train/*.exr"))
            self.assertTrue(files)
            for path in files:
                with OpenEXR.File(str(path), separate_channels=True) as file:
                    planes = {name: channel.pixels.astype(float) for name, channel in file.channels().items()}
                for name in ("normal.X", "normal.Y", "normal.Z", "albedo1.R", "albedo1.G", "albedo1.B"):
                    few, many = planes[name], planes["ref." + name]
                    self.assertLess(abs(few.mean() - many.mean()), 0.02, name)
                    step = lambda plane: np.abs(plane[:, :-2] - 2 * plane[:, 1:-1] + plane[:, 2:]).mean()
                    self.assertLess(step(many), step(few), name)

    def test_albedo_is_that_of_what_a_mirror_shows(self) -> None:
        import numpy as np
        import tracer
        from variant import mi

        scene = self.scene()
        scene["ball"]["bsdf"] = {"type": "conductor", "material": "none"}
        scene = mi.load_dict(scene)
        plain, behind = (tracer.render(scene, 64, 1000, follow=follow).features for follow in (False, True))
        for name in ("normal", "position", "mask"):
            np.testing.assert_array_equal(plain[name], behind[name])
        ball = np.s_[22:25, 20:23]
        np.testing.assert_allclose(plain["albedo1"][ball] / 64, 1, atol=0.01)
        # It shows the box: its albedo is the second one of the plain image.
        np.testing.assert_allclose(behind["albedo1"][ball] / 64, plain["albedo2"][ball] / 64, atol=0.02)
        wall = np.s_[8:16, 1:4]
        np.testing.assert_array_equal(plain["albedo1"][wall], behind["albedo1"][wall])

    def test_a_moving_camera_gives_the_mean_over_its_way(self) -> None:
        import numpy as np
        import tracer
        from variant import mi

        def albedo(at: float, motion: np.ndarray | None = None) -> np.ndarray:
            scene = self.scene()
            scene["sensor"]["to_world"] = mi.ScalarTransform4f().translate([at, 0, 0]) @ scene["sensor"]["to_world"]
            return tracer.render(mi.load_dict(scene), 64, 1000, motion=motion).mean("albedo1")

        way = 0.6
        blurred, still = albedo(0, np.array([way, 0, 0])), albedo(0)
        mean = np.mean([albedo(way * ((step + 0.5) / 16 - 0.5)) for step in range(16)], axis=0)
        far = np.abs(still - mean).mean()
        self.assertGreater(far, 0.01)
        self.assertLess(np.abs(blurred - mean).mean(), 0.3 * far)

    def test_each_view_has_its_own_counts_and_traits(self) -> None:
        import numpy as np
        import views

        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder)
            ask = ("--preset", "train", "--rooms", 0, "--stills", 4, "--views", 1, "--size", 32, "--ref-spp", 64, "--spp", "1,2,4,16", "--traits", 1, "--moving", 1)
            ended = run("-o", out, *ask)
            self.assertEqual(ended.returncode, 0, ended.stderr)
            scenes = json.loads((out / "manifest.json").read_text())["scenes"]
            counts: dict[str, list[int]] = {}
            for scene in scenes:
                counts.setdefault(scene["base"], []).append(scene["spp"])
            self.assertEqual(len(counts), 4)
            self.assertGreater(len({tuple(sorted(drawn)) for drawn in counts.values()}), 1)
            self.assertTrue(all(len(drawn) <= len({*drawn}) <= 3 for drawn in counts.values()))
            for scene in scenes:
                self.assertEqual(scene["repeat"], 2 if scene["spp"] == 16 else 1)
                self.assertTrue(0.35 <= scene["pixel_filter_sigma"] <= 0.75 and scene["albedo_behind_glass"])
                self.assertTrue(0.003 <= np.linalg.norm(scene["camera_motion"]) <= 0.04)
        # The noise of neighbouring pixels is correlated, and the mean stays.
        noise = np.random.default_rng(1).standard_normal((64, 64, 3))
        wide = views.filtered(noise, 0.5)
        self.assertGreater(np.corrcoef(wide[:, 1:].ravel(), wide[:, :-1].ravel())[0, 1], 0.15)
        np.testing.assert_allclose(views.filtered(np.full((8, 8, 3), 0.7), 0.75), 0.7)
        np.testing.assert_array_equal(views.filtered(noise, 0.0), noise)

    def test_training_and_held_out_scenes_draw_different_things(self) -> None:
        import comparison
        import numpy as np
        import reserved
        from rooms import Room
        from stills import Still

        def called(room_class: type, still_class: type) -> set[str]:
            """The functions that draw 15 rooms and still lifes."""
            names: set[str] = set()

            def note(frame, event: str, _) -> None:
                if event == "call" and Path(frame.f_code.co_filename).parent == FOLDER:
                    names.add(frame.f_code.co_qualname.partition(".<locals>")[0])

            sys.setprofile(note)
            try:
                for index in range(15):
                    rng, grains = (np.random.default_rng([5, index, stream]) for stream in range(2))
                    room = room_class(rng, 0.6, grains)
                    room.sun(rng)
                    room.blacken(rng)
                    room.camera(rng, SIDE)
                    still = still_class(rng, 0.6, grains)
                    still.darken(rng)
                    still.camera(rng, SIDE)
            finally:
                sys.setprofile(None)
            return names

        training = called(Room, Still)
        held_out = called(reserved.ReservedRoom, reserved.ReservedStill)
        compared = called(comparison.ComparisonRoom, comparison.ComparisonStill) | called(comparison.ComparisonRoom, comparison.GlassBalls)
        self.assertEqual(training & held_out, SHARED | {"Stage.add_sun"})
        self.assertEqual(held_out & compared, SHARED)
        self.assertEqual(training & compared, SHARED | {"globe"})
        for module, drawn in ((reserved, held_out), (comparison, compared)):
            own = [value for value in vars(module).values() if getattr(value, "__module__", "") == module.__name__]
            functions = {function.__qualname__ for function in own if not isinstance(function, type)}
            functions |= {f"{kind.__name__}.{name}" for kind in own if isinstance(kind, type) for name, value in vars(kind).items() if callable(value) and not isinstance(value, staticmethod)}
            self.assertEqual(functions - drawn, set())

    def test_the_comparison_has_three_parts(self) -> None:
        import OpenEXR

        with tempfile.TemporaryDirectory() as empty:
            out = Path(empty) / "set"
            ended = run("-o", out, "--preset", "comparison", "--rooms", 1, "--stills", 1, "--views", 1, "--size", SIDE, "--ref-spp", 16)
            self.assertEqual(ended.returncode, 0, ended.stderr)
            manifest = json.loads((out / "manifest.json").read_text())
            scenes = manifest["scenes"]
            views = {scene["name"]: scene["split"] for scene in scenes} | dict.fromkeys(manifest["left_out"], "left out")
            expected = {f"{kind}-{seed}-0-0" for kind in ("room", "still") for seed in (2029, 3029, 4029)}
            self.assertEqual({*views}, expected)
            self.assertEqual(views["still-2029-0-0"], "train")
            self.assertEqual(views["still-4029-0-0"], "test")
            with OpenEXR.File(str(out / scenes[0]["file"]), separate_channels=True) as file:
                self.assertIn("half1.R", file.channels())

    def test_a_shard_outside_1_to_n_is_an_error(self) -> None:
        for part in ("0/4", "5/4", "x"):
            with tempfile.TemporaryDirectory() as empty:
                ended = run("-o", empty, "--rooms", 1, "--shard", part)
            self.assertEqual(ended.returncode, 2)
            self.assertIn("expected I/N with I from 1 to N, such as 1/4", ended.stderr)

    def test_nothing_to_render_is_an_error(self) -> None:
        with tempfile.TemporaryDirectory() as empty:
            ended = run("-o", empty)
        self.assertEqual(ended.returncode, 2)
        self.assertIn("nothing to render", ended.stderr)
