"""Tests of the Blender extension in `bindings/blender`, without a window (`pip install bpy numpy OpenEXR`).

    DEMC_INFER=target/release/demc-infer python -m unittest tests/renderers/test_blender.py

Without bpy they are skipped, unless DEMC_REQUIRE_BPY=1. Without DEMC_INFER, `target/release/demc-infer` is run.
"""

import os
import sys
import tempfile
import time
import unittest
import unittest.mock
import zipfile
from pathlib import Path
from types import SimpleNamespace

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
FOLDER = tempfile.TemporaryDirectory()
# Blender then neither reads nor changes the user's own preferences.
os.environ["BLENDER_USER_RESOURCES"] = FOLDER.name

try:
    import bpy
except ImportError:
    if os.environ.get("DEMC_REQUIRE_BPY") == "1":
        raise
    bpy = None

PROGRAM = os.environ.get("DEMC_INFER", str(ROOT / "target" / "release" / "demc-infer"))
MODULE = "bl_ext.user_default.demc_denoiser"


def files(name: str) -> str:
    return str(Path(FOLDER.name) / name)


@unittest.skipIf(bpy is None, "no bpy")
class Extension(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        sys.path.insert(0, str(HERE))
        import scenes
        import with_cycles

        cls.scene = with_cycles.build(scenes.scene(15))
        archive = files("demc_denoiser.zip")
        with zipfile.ZipFile(archive, "w") as package:
            for file in (ROOT / "bindings" / "blender").iterdir():
                if file.is_file():
                    package.write(file, file.name)
        bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
        cls.preferences = bpy.context.preferences.addons[MODULE].preferences
        render = cls.scene.render
        render.engine = "CYCLES"
        render.resolution_x = render.resolution_y = 64
        render.filepath = files("shot-")
        cls.scene.cycles.use_adaptive_sampling = False

    def setUp(self):
        self.preferences.program, self.preferences.model = PROGRAM, ""
        bpy.ops.demc.set_passes()

    @classmethod
    def render(cls, path, spp, seed):
        cls.scene.cycles.samples, cls.scene.cycles.seed = spp, seed
        bpy.ops.render.render()
        bpy.data.images["Render Result"].save_render(path, scene=cls.scene)

    def failure(self, call, **arguments) -> str:
        """The sentence with which an operator fails."""
        with self.assertRaises(RuntimeError) as caught:
            call(**arguments)
        message = str(caught.exception).strip()
        self.assertTrue(message.startswith("Error: ") and message.endswith("."), message)
        self.assertEqual(message.count("\n"), 0, message)
        return message.removeprefix("Error: ")

    def assert_nearer(self, denoised, noisy):
        """The denoised file is nearer to the reference, and all other passes are those of the noisy file."""
        from compare import channels, image_of, rel_mse

        if not Path(files("reference.exr")).exists():
            self.render(files("reference.exr"), 256, 9)
        reference, before, after = (image_of("cycles", Path(path)) for path in (files("reference.exr"), noisy, denoised))
        self.assertLess(rel_mse(after, reference), 0.7 * rel_mse(before, reference))
        before, after = channels(Path(noisy)), channels(Path(denoised))
        self.assertEqual(list(before), list(after))
        for name, plane in before.items():
            if not name.startswith("ViewLayer.Combined.") or name.endswith(".A"):
                self.assertTrue((plane == after[name]).all(), name)

    @unittest.skipUnless(os.environ.get("DEMC_REQUIRE_WHEEL") == "1", "the wheel is not required")
    def test_the_wheel_denoises_in_blenders_process(self):
        import demc
        from compare import image_of, rel_mse

        noisy, denoised = files("wheel-noisy.exr"), files("wheel.exr")
        self.render(noisy, 4, 3)
        demc.denoise_exr(noisy, denoised)
        self.assert_nearer(denoised, noisy)
        frame = demc.torch.read_exr(noisy)
        features = dict(zip(("normal", "position", "albedo"), frame.features.reshape(4, *frame.color.shape)))
        image = demc.denoise(frame.color, **features)
        reference, before = (image_of("cycles", Path(path)) for path in (files("reference.exr"), noisy))
        self.assertLess(rel_mse(image.transpose(1, 2, 0), reference), 0.7 * rel_mse(before, reference))

    def test_passes_of_a_new_scene_are_set(self):
        layer, image = self.scene.view_layers[0], self.scene.render.image_settings
        self.assertTrue(layer.use_pass_normal and layer.use_pass_position and layer.cycles.denoising_store_passes)
        self.assertEqual(self.scene.cycles.pixel_filter_type, "BOX")
        self.assertEqual((image.file_format, image.color_depth), ("OPEN_EXR_MULTILAYER", "32"))
        self.assertFalse(self.scene.cycles.use_denoising)

    def test_a_reference_is_a_plain_file_with_another_seed(self):
        seed, path = self.scene.cycles.seed, files("plain.exr")
        bpy.ops.demc.set_reference(samples=2)
        self.assertEqual((self.scene.cycles.samples, self.scene.cycles.seed), (2, seed + 1))
        bpy.ops.render.render()
        bpy.data.images["Render Result"].save_render(path, scene=self.scene)
        from compare import channels

        planes = channels(Path(path))
        self.assertLessEqual({"R", "G", "B"}, set(planes))
        self.assertEqual({str(plane.dtype) for plane in planes.values()}, {"float32"})

    def test_a_file_is_denoised_and_loaded(self):
        noisy, denoised = files("noisy.exr"), files("clean.exr")
        self.render(noisy, 4, 0)
        self.assertEqual(bpy.ops.demc.denoise_file(filepath=noisy, output=denoised), {"FINISHED"})
        self.assert_nearer(denoised, noisy)
        self.assertIn(denoised, [image.filepath for image in bpy.data.images])

    def test_without_an_output_the_file_beside_the_input_is_written(self):
        noisy = files("beside.exr")
        self.render(noisy, 4, 0)
        bpy.ops.demc.denoise_file(filepath=noisy)
        self.assert_nearer(files("beside-denoised.exr"), noisy)

    def test_a_render_is_denoised(self):
        self.scene.cycles.samples, self.scene.cycles.seed = 4, 0
        self.assertEqual(bpy.ops.demc.render_and_denoise(), {"FINISHED"})
        self.assert_nearer(files("shot-0001-denoised.exr"), files("shot-0001.exr"))

    def test_of_several_view_layers_the_active_one_is_denoised(self):
        second = self.scene.view_layers.new("second layer")
        try:
            bpy.ops.demc.set_passes()
            self.scene.cycles.samples, self.scene.cycles.seed = 4, 0
            self.scene.frame_current = 2
            bpy.ops.demc.render_and_denoise()
        finally:
            self.scene.view_layers.remove(second)
            self.scene.frame_current = 1
        from compare import channels

        before, after = (channels(Path(files(name))) for name in ("shot-0002.exr", "shot-0002-denoised.exr"))
        changed = {name for name, plane in before.items() if (plane != after[name]).any()}
        active = bpy.context.view_layer.name
        self.assertEqual(changed, {f"{active}.Combined.{channel}" for channel in "RGB"})

    def test_a_missing_program_is_named(self):
        self.preferences.program = files("no-program")
        message = self.failure(bpy.ops.demc.denoise_file, filepath=str(HERE / "files" / "cycles-5.0.exr"), output=files("x.exr"))
        self.assertIn("no-program: set the path of demc-infer", message)

    def test_a_missing_file_and_a_missing_model_are_named(self):
        self.assertIn("There is no file", self.failure(bpy.ops.demc.denoise_file, filepath=files("nothing.exr")))
        self.preferences.model = files("no.safetensors")
        message = self.failure(bpy.ops.demc.denoise_file, filepath=str(HERE / "files" / "cycles-5.0.exr"), output=files("x.exr"))
        self.assertIn("There is no model", message)

    def test_missing_passes_are_named(self):
        plain = str(HERE / "files" / "cycles-reference.exr")
        message = self.failure(bpy.ops.demc.denoise_file, filepath=plain, output=files("x.exr"))
        self.assertIn("ViewLayer.Normal.X", message)
        self.assertFalse(Path(files("x.exr")).exists())

    def test_the_last_render_is_denoised(self):
        self.scene.cycles.samples, self.scene.cycles.seed = 4, 0
        self.scene.frame_current = 3
        try:
            bpy.ops.render.render()
            bpy.ops.demc.denoise_render()
        finally:
            self.scene.frame_current = 1
        self.assert_nearer(files("shot-0003-denoised.exr"), files("shot-0003.exr"))

    def test_every_button_of_the_panel_calls_an_operator(self):
        layout = unittest.mock.MagicMock()
        sys.modules[MODULE].DEMC_PT_panel.draw(SimpleNamespace(layout=layout), bpy.context)
        buttons = [call.args[0] for call in layout.column().operator.call_args_list]
        self.assertEqual(len(buttons), 4)
        for button in buttons:
            self.assertTrue(getattr(bpy.ops.demc, button.removeprefix("demc.")).idname_py() == button)

    def background(self, output):
        """A button's work, with a window manager that only counts timers."""
        window_manager, reports = unittest.mock.MagicMock(), []
        context = SimpleNamespace(window_manager=window_manager, window=None, workspace=unittest.mock.MagicMock(), screen=None)
        work = sys.modules[MODULE].Denoising()
        work.report = lambda kind, text: reports.append((kind, text))
        source = str(HERE / "files" / "cycles-5.0.exr")
        self.assertEqual(work.begin(context, source, output, "", wait=False), {"RUNNING_MODAL"})
        return work, context, reports

    def test_a_button_works_in_the_background(self):
        work, context, reports = self.background(files("button.exr"))
        state = {"PASS_THROUGH"}
        while state == {"PASS_THROUGH"}:
            time.sleep(0.05)
            state = work.modal(context, SimpleNamespace(type="TIMER"))
        self.assertEqual(state, {"FINISHED"}, reports)
        context.window_manager.event_timer_remove.assert_called_once()
        self.assertTrue(Path(files("button.exr")).exists())

    def test_escape_stops_the_program(self):
        work, context, reports = self.background(files("stopped.exr"))
        self.assertEqual(work.modal(context, SimpleNamespace(type="ESC")), {"CANCELLED"})
        self.assertFalse(work.job.running())
        self.assertFalse(Path(files("stopped.exr")).exists())
        self.assertEqual(reports, [({"INFO"}, "Denoising was cancelled.")])

    def test_a_render_in_another_format_is_refused(self):
        image = self.scene.render.image_settings
        if hasattr(image, "media_type"):
            image.media_type = "IMAGE"
        image.file_format = "PNG"
        self.assertIn("press Set Passes", self.failure(bpy.ops.demc.denoise_render))


if __name__ == "__main__":
    unittest.main()
