"""Tests of `demc.torch.read_exr`: run `python -m unittest discover -s tests` in `bindings/python/`."""

import importlib.util
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
ROOT = PACKAGE.parents[1]
RENDERERS = ROOT / "tests" / "renderers" / "files"
MISSING = [name for name in ["numpy", "OpenEXR"] if importlib.util.find_spec(name) is None]

if not MISSING:
    import demc.torch
    import numpy as np
    import OpenEXR
    from demc.torch import layouts
    from demc.torch.exr import ExrFile

MITSUBA = ["R", "G", "B", *(f"normal.{x}" for x in "XYZ"), *(f"position.{x}" for x in "XYZ"), *(f"albedo.{x}" for x in "RGB")]
"""Channels of the layout mitsuba3."""


@unittest.skipIf(MISSING, f"no {', '.join(MISSING)}")
class Files(unittest.TestCase):
    """Writes small EXR files."""

    def setUp(self) -> None:
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.folder = Path(directory.name)
        self.path = self.folder / "x.exr"

    def planes(self, names, size=(4, 5), kind="f4") -> dict:
        rng = np.random.default_rng(1)
        return {name: rng.random(size).astype(kind) for name in names}

    def write(self, *parts: dict, **attributes: object) -> None:
        """Each of `parts` has channels; the parts are called a, b, c, ..."""
        header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **attributes}
        names = "abc" if len(parts) > 1 else [""]
        # OpenEXR changes the dictionaries that it gets.
        parts = [OpenEXR.Part(dict(header), dict(part), name) for part, name in zip(parts, names)]
        OpenEXR.File(parts).write(str(self.path))

    def refused(self, message: str, *arguments: object, **named: object) -> None:
        with self.assertRaises(ValueError) as caught:
            demc.torch.read_exr(self.path, *arguments, **named)
        self.assertIn(message, str(caught.exception))
        self.assertNotIn("\n", str(caught.exception))


class Detection(Files):
    def test_both_forms_of_cycles_files_have_the_same_buffers(self) -> None:
        one, several = (demc.torch.read_exr(RENDERERS / f"cycles-{version}.exr") for version in ("4.5", "5.0"))
        self.assertEqual((len(one.file.parts), len(several.file.parts)), (1, 6))
        for frame in (one, several):
            names = frame.layout.name, frame.layout.layer
            self.assertEqual(names, ("cycles", "ViewLayer"))
            self.assertEqual(frame.layout.channels["color"][0], "ViewLayer.Combined.R")
            albedo = frame.file.channels["ViewLayer.Denoising Albedo.G"].pixels
            np.testing.assert_array_equal(frame.features[7], albedo)
            np.testing.assert_array_equal(frame.features[10], albedo)
        np.testing.assert_allclose(one.features[3:6], several.features[3:6], atol=1e-4)

    def test_the_choice_names_what_replaces_missing_buffers(self) -> None:
        self.write(self.planes(name for name in MITSUBA if not name.startswith("position")))
        text = "layout mitsuba3; no position: zeros replace it; no texture2: texture1 replaces it"
        frame = demc.torch.read_exr(self.path)
        self.assertEqual(frame.layout.describe(), text)
        self.assertEqual(np.abs(frame.features[3:6]).max(), 0)
        np.testing.assert_array_equal(frame.features[6:9], frame.features[9:])

    def test_the_names_in_mitsubas_manual_are_found(self) -> None:
        renamed = lambda normal, position: [
            name.replace("normal", normal).replace("position", position) for name in MITSUBA
        ]
        for normal, position in (("nn", "pos"), ("normals", "pos"), ("normal", "pos")):
            self.write(self.planes(renamed(normal, position)))
            for preset in (None, "mitsuba3"):
                frame = demc.torch.read_exr(self.path, preset)
                self.assertEqual(frame.layout.name, "mitsuba3")
                self.assertEqual(frame.layout.channels["normal"][0], f"{normal}.X")
                self.assertEqual(frame.layout.channels["position"][2], f"{position}.Z")
        self.write(self.planes(name for name in renamed("nn", "pos") if name != "nn.Y"))
        self.refused("the nearest, mitsuba3, lacks nn.Y")
        self.write(self.planes(MITSUBA + renamed("nn", "pos")[3:9]))
        self.assertEqual(demc.torch.read_exr(self.path).layout.channels["normal"][0], "normal.X")
        self.write(self.planes(renamed("nnn", "pos")))
        self.refused("the nearest, mitsuba3, lacks normal.X, normal.Y, normal.Z")

    def test_alternatives_need_names_and_name_no_channel_twice(self) -> None:
        table = {"color": ["a", "b", "c"], "normal": ["d", "e", "f"], "missing": dict.fromkeys(layouts.BUFFERS[1:], "zeros")}
        table["alternatives"] = {"normal": [["g", "h", "a"]], "position": [["x", "y", "z"]], "depth": []}
        with self.assertRaises(ValueError) as caught:
            layouts.Layout.from_table("own", table)
        for problem in ('channel "a" is named twice', "alternatives.position needs position", "unknown key alternatives.depth"):
            self.assertIn(problem, str(caught.exception))

    def test_a_view_layer_is_chosen_among_several(self) -> None:
        names = [f"{layer}.{name}" for layer in ("Glass", "Wood") for name in CYCLES]
        self.write(self.planes(names))
        for preset in (None, "cycles"):
            frame = demc.torch.read_exr(self.path, preset, "Wood")
            self.assertEqual(frame.layout.channels["color"][2], "Wood.Combined.B")
            self.refused('no view layer "Iron"; there is Glass, Wood', preset, "Iron")
        self.refused("view layers Glass, Wood: choose one", "cycles")
        self.refused('several presets fit equally well: cycles with view layer "Glass", cycles with view layer "Wood"')
        self.refused('view layer "Wood": the names of the layout have no `*`', "mitsuba3", "Wood")

    def test_a_layer_with_more_buffers_wins(self) -> None:
        # The second layer has no position.
        names = [f"Glass.{name}" for name in CYCLES] + [f"Wood.{name}" for name in CYCLES if "Position" not in name]
        self.write(self.planes(names))
        self.assertEqual(demc.torch.read_exr(self.path).layout.layer, "Glass")

    def test_presets_that_fit_equally_well_are_named(self) -> None:
        pbrt = [f"{buffer}.{x}" for buffer in ("Ns", "P") for x in "XYZ"] + [f"Albedo.{x}" for x in "RGB"]
        self.write(self.planes(MITSUBA + pbrt))
        self.refused("several presets fit equally well: mitsuba3, pbrt-v4; choose one")
        self.assertEqual(demc.torch.read_exr(self.path, "pbrt-v4").layout.channels["normal"][0], "Ns.X")

    def test_the_nearest_preset_is_named_with_what_it_lacks(self) -> None:
        self.write(self.planes(name for name in MITSUBA if name != "normal.Y"))
        self.refused("no preset fits; the nearest, mitsuba3, lacks normal.Y")
        self.refused("no channel *.Combined.R, *.Combined.G, *.Combined.B; the file has", "cycles")
        self.write(self.planes(["beauty.r", "depth"]))
        self.refused("no preset has any of its channels: beauty.r, depth")

    def test_the_models_own_layout_comes_first(self) -> None:
        own = {"color": ["a", "b", "c"], "missing": {"normal": "zeros", "texture1": "zeros", "texture2": "zeros"}}
        own["missing"]["position"] = "zeros"
        self.write(self.planes(["a", "b", "c", *MITSUBA]))
        self.assertEqual(demc.torch.read_exr(self.path, bundle={"layout": own}).layout.channels["color"], ("a", "b", "c"))
        # Its policies also hold for presets.
        self.write(self.planes("RGB") | self.planes(["albedo.R", "albedo.G", "albedo.B"]))
        self.refused("lacks normal.X")
        self.assertEqual(demc.torch.read_exr(self.path, bundle={"layout": own}).layout.name, "mitsuba3")


class Buffers(Files):
    def test_positions_without_a_hit_become_zero(self) -> None:
        planes = self.planes(MITSUBA)
        for axis, value in zip("XYZ", (np.inf, -np.inf, np.inf)):
            planes[f"position.{axis}"][1, 2] = value
        self.write(planes)
        features = demc.torch.read_exr(self.path).features
        np.testing.assert_array_equal(features[3:6, 1, 2], 0)
        self.assertGreater(features[3:6, 1, 3].min(), 0)
        planes["position.Y"][1, 2] = 1
        self.write(planes)
        self.refused("channel position.X: inf at x 2, y 1 (1 NaN or infinite samples in all)")

    def test_nan_is_located_and_negative_radiance_becomes_zero(self) -> None:
        planes = self.planes(MITSUBA)
        planes["G"][3, 0] = -1
        self.write(planes)
        self.assertEqual(demc.torch.read_exr(self.path).color[1, 3, 0], 0)
        planes["albedo.B"][2, 4] = np.nan
        self.write(planes)
        self.refused("channel albedo.B: nan at x 4, y 2 (1 NaN or infinite samples in all)")

    def test_a_reference_is_read_if_present(self) -> None:
        self.write(self.planes([*MITSUBA, "ref.R", "ref.G", "ref.B"]))
        self.assertEqual(demc.torch.read_exr(self.path).reference.shape, (3, 4, 5))
        # Denoising does not need it.
        self.write(self.planes([*MITSUBA, "ref.R"]))
        with self.assertRaisesRegex(ValueError, "no channel ref.G, ref.B; the file has"):
            demc.torch.read_exr(self.path).reference
        planes = self.planes([*MITSUBA, "ref.R", "ref.G", "ref.B"])
        planes["ref.G"][0, 1] = np.inf
        self.write(planes)
        with self.assertRaisesRegex(ValueError, "channel ref.G: inf at x 1, y 0"):
            demc.torch.read_exr(self.path).reference

    def test_parts_of_different_sizes_are_refused(self) -> None:
        layout = self.folder / "parts.toml"
        layout.write_text(MULTI)
        display = np.array([0, 0], np.int32), np.array([9, 9], np.int32)
        self.write(self.planes("RGB"), self.planes("XYZ", (4, 6)), self.planes("RGB"), displayWindow=display)
        self.refused("buffers of different sizes: a.R is 5x4, b.X is 6x4", str(layout))
        self.write(self.planes("RGB"), self.planes("XYZ"), self.planes("RGB"))
        np.testing.assert_array_equal(demc.torch.read_exr(self.path, str(layout)).features[0], self.planes("XYZ")["X"])

    def test_damaged_files_are_one_sentence(self) -> None:
        with self.assertRaises(FileNotFoundError):
            demc.torch.read_exr(self.path)
        self.path.write_bytes(b"no image")
        self.refused("not a readable OpenEXR file")
        whole = (RENDERERS / "cycles-5.0.exr").read_bytes()
        self.path.write_bytes(whole[: 2 * len(whole) // 3])
        self.refused("not a readable OpenEXR file")

    def test_mistakes_in_a_layout_are_named(self) -> None:
        self.write(self.planes(MITSUBA))
        self.refused("neither a preset (demc-exr, mitsuba3, pbrt-v4, cycles, luxcore, fbksd) nor a file", "mitsuba")
        layout = self.folder / "mine.toml"
        good = 'color = ["R", "G", "B"]\nmissing = {normal = "zeros", position = "zeros", texture1 = "zeros", texture2 = "zeros"}\n'
        for text, message in [
            (good.replace("B", "R"), 'channel "R" is named twice'),
            (good.replace(', "B"', ""), "color: expected three names of channels"),
            (good + 'noraml = ["a", "b", "c"]', "unknown key noraml"),
            (good.replace("normal", "norm"), "normal names no channels: name them or set missing.normal; unknown key missing.norm"),
            (good.replace('"zeros"', '"copy-texture1"'), 'missing.normal cannot be "copy-texture1"'),
            (good.replace('"zeros"', '"black"'), "missing.normal: expected"),
            (good + "mask = 3", "mask: expected the name of a channel"),
            (good + "passes = 3", "passes: expected a table"),
            ("color = [", "channel layout "),
        ]:
            layout.write_text(text)
            self.refused(message, str(layout))
        layout.write_text(good)
        self.assertEqual(demc.torch.read_exr(self.path, str(layout)).features.max(), 0)


class Writing(Files):
    def copy(self, precision: str | None = None) -> tuple["ExrFile", "ExrFile"]:
        """The file at `path`, and its copy with colour 0.5."""
        frame = demc.torch.read_exr(self.path)
        frame.write(self.folder / "y.exr", np.full_like(frame.color, 0.5), precision)
        self.assertEqual(sorted(p.name for p in self.folder.glob("*.exr")), ["x.exr", "y.exr"])
        self.assertFalse(list(self.folder.glob(".*")))
        return frame.file, ExrFile(self.folder / "y.exr")

    def assert_only_colour_changed(self, was: "ExrFile", now: "ExrFile", color: set[str]) -> None:
        self.assertEqual(list(was.channels), list(now.channels))
        for name, channel in was.channels.items():
            copied = now.channels[name].pixels
            if name in color:
                np.testing.assert_array_equal(copied, 0.5)
            else:
                self.assertEqual((copied.dtype, copied.tobytes()), (channel.pixels.dtype, channel.pixels.tobytes()), name)
        for a, b in zip(was.parts, now.parts, strict=True):
            # OpenEXR adds these; a name only before 3.5.
            added = {"chunkCount", "name"} - a.header.keys()
            header = {key: value for key, value in b.header.items() if key not in added}
            self.assertEqual(str(a.header), str(header))

    def test_parts_attributes_and_other_channels_stay(self) -> None:
        for name in ("cycles-4.5.exr", "cycles-5.0.exr", "mitsuba-3.9.exr"):
            self.path.write_bytes((RENDERERS / name).read_bytes())
            prefix = "ViewLayer.Combined." if name.startswith("cycles") else ""
            self.assert_only_colour_changed(*self.copy(), {prefix + x for x in "RGB"})

    def test_windows_tiles_types_and_nan_of_other_channels_stay(self) -> None:
        planes = self.planes(MITSUBA) | self.planes("RG", kind="f2") | {"id": np.arange(20, dtype="u4").reshape(4, 5)}
        planes["depth"] = np.full((4, 5), np.nan, "f4")
        corner = lambda x, y: np.array([x, y], np.int32)
        self.write(planes, dataWindow=(corner(3, 2), corner(7, 5)), displayWindow=(corner(0, 0), corner(9, 9)), note="kept")
        was, now = self.copy()
        self.assert_only_colour_changed(was, now, set("RGB"))
        self.assertEqual(now.window("R"), "5x4+3+2")
        self.assertEqual([now.channels[x].pixels.dtype for x in "RGB"], ["f2", "f2", "f4"])
        tiles = OpenEXR.TileDescription()
        tiles.xSize, tiles.ySize = 16, 16
        self.write(planes, type=OpenEXR.tiledimage, tiles=tiles)
        self.assert_only_colour_changed(*self.copy(), set("RGB"))
        self.assertEqual({self.copy("float")[1].channels[x].pixels.dtype for x in "RGB"}, {np.dtype("f4")})

    def test_layers_are_chosen_by_patterns_and_written(self) -> None:
        self.write(self.planes(MITSUBA) | self.planes(["lamp.R", "lamp.G", "fog.A"], kind="f2") | self.planes(["id"], kind="u4"))
        frame = demc.torch.read_exr(self.path)
        layers = frame.layers("lamp.*", "[RGB]", "*.A")
        self.assertEqual(sorted(layers), ["fog.A", "lamp.G", "lamp.R"])
        self.assertEqual(layers["fog.A"].dtype, np.float32)
        frame.write(self.folder / "y.exr", frame.color, layers={name: 0.25 - plane for name, plane in layers.items()})
        written = ExrFile(self.folder / "y.exr").channels
        for name, plane in layers.items():
            np.testing.assert_allclose(written[name].pixels, 0.25 - plane, atol=5e-4)
        np.testing.assert_array_equal(written["id"].pixels, frame.file.channels["id"].pixels)
        for pattern, message in (
            ("sun.*", "no channel matches sun.*; the file has B, "),
            ("normal.X", "channel normal.X is no layer: it is the normal that the network sees"),
            ("id", "channel id is no layer: its type is uint, not half or float"),
        ):
            with self.assertRaises(ValueError) as caught:
                frame.layers(pattern)
            self.assertIn(message, str(caught.exception))

    def test_lossy_compression_becomes_zip(self) -> None:
        rng = np.random.default_rng(2)
        self.write({name: rng.random((64, 64), "f4") for name in MITSUBA}, compression=OpenEXR.DWAB_COMPRESSION)
        was, now = self.copy()
        self.assertEqual(now.parts[0].header["compression"], OpenEXR.ZIP_COMPRESSION)
        np.testing.assert_array_equal(was.channels["normal.X"].pixels, now.channels["normal.X"].pixels)

    def test_large_values_stay_finite_in_half_precision(self) -> None:
        self.write(self.planes(MITSUBA, kind="f2"))
        frame = demc.torch.read_exr(self.path)
        frame.write(self.path, np.full_like(frame.color, 1e6))
        self.assertEqual(demc.torch.read_exr(self.path).color.max(), 65504)

    def test_another_size_or_folder_is_refused(self) -> None:
        self.write(self.planes(MITSUBA))
        frame = demc.torch.read_exr(self.path)
        with self.assertRaisesRegex(ValueError, r"image is \[3, 4, 4\]: expected \[3, 4, 5\]"):
            frame.write(self.path, frame.color[:, :, :4])
        with self.assertRaisesRegex(ValueError, "precision 'double': expected half or float"):
            frame.write(self.path, frame.color, "double")
        with self.assertRaisesRegex(OSError, "cannot write"):
            frame.write(self.folder / "none" / "y.exr", frame.color)


class Preprocessing(Files):
    META = {"normalizer": {}, "ranges": {"exposure": {"low": 0.1, "high": 0.4}}}

    def test_the_package_reads_and_prepares_without_pytorch(self) -> None:
        script = (
            "import sys; sys.modules['torch'] = None\n"
            "import demc.torch\n"
            f"frame = demc.torch.read_exr({str(RENDERERS / 'mitsuba-3.9.exr')!r})\n"
            "meta = {'normalizer': {'position': 'image'}}\n"
            "print(demc.torch.preprocess.prepare(frame.color, frame.features, meta).features.shape)\n"
            "try: demc.torch.load\n"
            "except ImportError as error: print('no', error.name)\n"
        )
        done = subprocess.run([sys.executable, "-c", script], cwd=PACKAGE, capture_output=True, text=True)
        self.assertEqual(done.stdout, "(12, 64, 64)\nno torch\n", done.stderr)

    def test_exposures_outside_the_range_move_to_its_middle(self) -> None:
        scale = lambda level: demc.torch.preprocess.input_scale(np.full((3, 4, 4), level), self.META)
        self.assertEqual([scale(level) for level in (0, 0.06, 0.2, 0.7)], [1] * 4)
        self.assertAlmostEqual(scale(2), 0.1, places=6)
        self.assertAlmostEqual(scale(0.002), 100, places=3)

    def test_with_an_exposure_level_every_image_is_scaled(self) -> None:
        meta = self.META | {"normalizer": {"exposure_level": 0.3}}
        scale = lambda level: demc.torch.preprocess.input_scale(np.full((3, 4, 4), level), meta)
        for level in (0.05, 0.2, 3):
            self.assertAlmostEqual(scale(level) * level / 0.3, 1, places=5)
        self.assertEqual([scale(0), scale(1e-12), scale(1e12)], [1, 1e6, float(np.float32(1e-6))])

    def test_edges_are_repeated_to_multiples_of_32(self) -> None:
        image = np.random.default_rng(3).random((3, 33, 32))
        padded = demc.torch.preprocess.pad(image)
        self.assertEqual(padded.shape, (3, 64, 32))
        np.testing.assert_array_equal(padded[:, 60], image[:, 32])


class Presets(unittest.TestCase):
    @unittest.skipIf(MISSING, f"no {', '.join(MISSING)}")
    def test_all_files_of_the_repository_are_presets(self) -> None:
        files = {path.stem for path in (ROOT / "configs" / "renderers").glob("*.toml")}
        self.assertEqual(files, set(layouts.PRESETS))
        for name in files:
            self.assertEqual(layouts.preset(name).name, name)


CYCLES = [
    *(f"Combined.{x}" for x in "RGB"),
    *(f"{buffer}.{x}" for buffer in ("Normal", "Position") for x in "XYZ"),
    *(f"Denoising Albedo.{x}" for x in "RGB"),
]
"""Channels of a view layer of the layout cycles."""
MULTI = """
color = ["a.R", "a.G", "a.B"]
normal = ["b.X", "b.Y", "b.Z"]
texture1 = ["c.R", "c.G", "c.B"]
missing = {position = "zeros", texture2 = "copy-texture1"}
"""
"""A layout of three parts."""

if __name__ == "__main__":
    unittest.main()
