"""Tests of `demc.denoise` and `demc.Model` against `demc-infer`.

Install the wheel and OpenEXR, put `demc-infer` of the same build on the `PATH` or into target/release, and
run `python -m unittest bindings/python/tests/test_native.py` in the repository root. Without the wheel the tests
are skipped, unless DEMC_REQUIRE_WHEEL=1.
"""

import importlib.util
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import unittest
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
SAMPLE = ROOT / "data" / "sample"
RENDERERS = ROOT / "tests" / "renderers" / "files"
BUILT = ROOT / "target" / "release"
MISSING = [name for name in ("numpy", "OpenEXR", "demc") if importlib.util.find_spec(name) is None]
if "demc" not in MISSING and importlib.util.find_spec("demc._native") is None:
    MISSING.append("demc._native")
IS_SKIPPED = bool(MISSING) and os.environ.get("DEMC_REQUIRE_WHEEL") != "1"
if not IS_SKIPPED:
    import demc
    import numpy as np
    from demc.torch import read_exr

FEATURES = ("normal", "position", "albedo", "albedo2")


def program(name: str) -> str:
    """The program of the build, not the wheel's."""
    built = BUILT / name
    found = str(built) if built.is_file() else shutil.which(name)
    if found is None:
        raise unittest.SkipTest(f"no {name}")
    return found


class Interruption(Exception):
    """Raised in callbacks."""


def denoise_in_child(results: multiprocessing.Queue) -> None:
    try:
        demc.Model()
        results.put("loaded")
    except RuntimeError as error:
        results.put(str(error))


@unittest.skipIf(IS_SKIPPED, f"no {', '.join(MISSING)}")
class Native(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        cls.color, cls.features = cls.planes(SAMPLE / "test" / "gen-table-test-1.exr")
        # 64x96 pixels, so that most tests are fast.
        cut = (slice(None), slice(64, 128), slice(64, 160))
        cls.small = cls.color[cut].copy()
        cls.guides = {name: plane[cut].copy() for name, plane in cls.features.items()}
        cls.clean = demc.denoise(cls.small, **cls.guides)

    @staticmethod
    def planes(path: Path):
        """Colour and features, [3, height, width], as `demc-infer` reads them."""
        frame = read_exr(path)
        return frame.color, dict(zip(FEATURES, frame.features.reshape(4, *frame.color.shape)))

    def denoise(self, color, **options):
        return demc.denoise(color, **{**self.guides, **options})

    def refused(self, kind: type, text: str, color, **options) -> None:
        with self.assertRaises(kind) as caught:
            self.denoise(color, **options)
        self.assertIn(text, str(caught.exception))
        self.assertNotIn("\n", str(caught.exception))


class Numbers(Native):
    def commanded(self, path: Path, *options: str):
        """The denoised file of `demc-infer denoise`, in float."""
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder, "x.exr")
            command = [program("demc-infer"), "denoise", path, "-o", target, "--precision", "float", *options]
            done = subprocess.run(command, capture_output=True, text=True)
            self.assertEqual(done.returncode, 0, done.stderr)
            frame = read_exr(target)
            alpha = frame.file.planes(frame.layout.channels["alpha"]) if "alpha" in frame.layout.channels else None
            return frame.color, alpha

    def test_bytes_are_those_of_the_command_line(self) -> None:
        for path in sorted((SAMPLE / "test").glob("*.exr")):
            with self.subTest(path.name):
                color, features = self.planes(path)
                expected, _ = self.commanded(path)
                self.assertEqual(demc.denoise(color, **features).tobytes(), expected.tobytes())

    def test_alpha_and_options_are_those_of_the_command_line(self) -> None:
        path = RENDERERS / "cycles-alpha.exr"
        frame = read_exr(path)
        color, features = self.planes(path)
        alpha = frame.file.planes(frame.layout.channels["alpha"])[0]
        expected, expected_alpha = self.commanded(path, "--ensemble", "4", "--input-scale", "0.5", "--restore-light", "off")
        options = {"passes": 4, "input_scale": 0.5, "restore_light": False}
        with warnings.catch_warnings(action="ignore"):
            found = demc.denoise(color, alpha=alpha, **features, **options)
        self.assertEqual(found.color.tobytes(), expected.tobytes())
        self.assertEqual(found.alpha.tobytes(), expected_alpha[0].tobytes())
        self.assertEqual(found.layers, {})

    def test_an_absent_albedo2_and_position_are_replaced(self) -> None:
        guides = self.guides
        found = demc.denoise(self.small, normal=guides["normal"], albedo=guides["albedo"])
        expected = self.denoise(self.small, position=np.zeros_like(self.small), albedo2=guides["albedo"])
        self.assertEqual(found.tobytes(), expected.tobytes())

    def test_the_model_describes_itself(self) -> None:
        model = demc.Model.load()
        self.assertIs(model, demc.Model.load())
        self.assertEqual((model.name, model.required, model.takes_layers), ("quality", ("normal", "albedo"), True))
        self.assertEqual(model.metadata["format"], 1)
        self.assertEqual(model.step, model.metadata["step"])
        self.assertTrue(demc.Model.load("fast").takes_layers)
        self.assertIsNot(demc.Model.load("fast"), model)
        file = demc.Model.load(ROOT / "models" / "quality.safetensors")
        self.assertEqual(file.denoise(self.small, **self.guides).tobytes(), self.clean.tobytes())
        scale = model.input_scale(self.small)
        self.assertEqual(self.denoise(self.small, input_scale=scale).tobytes(), self.clean.tobytes())


class Layouts(Native):
    def variants(self, image):
        """The same image [3, height, width] in memory of every kind, with the view back."""
        pixels = np.ascontiguousarray(image.transpose(1, 2, 0))
        wide = np.full((image.shape[1] * 2, image.shape[2] * 3, 5), 9, np.float32)
        wide[::2, ::3, 1:4] = pixels
        flipped = np.ascontiguousarray(pixels[::-1, ::-1, ::-1])
        frozen = pixels.copy()
        frozen.flags.writeable = False
        odd = np.frombuffer(b"x" + pixels.tobytes(), np.uint8)[1:].view(np.float32).reshape(pixels.shape)
        same = lambda x: x
        planar = lambda x: x.transpose(2, 0, 1)
        yield "planar", image, same
        yield "pixels", pixels, planar
        yield "part of a larger image", wide[::2, ::3, 1:4], planar
        yield "flipped", flipped[::-1, ::-1, ::-1], planar
        yield "columns first", np.asfortranarray(pixels), planar
        yield "read-only", frozen, planar
        yield "not aligned", odd, planar

    def test_every_layout_gives_the_same_samples(self) -> None:
        guides = {name: list(self.variants(guide)) for name, guide in self.guides.items()}
        for index, (what, color, planar) in enumerate(self.variants(self.small)):
            with self.subTest(what):
                own = {name: variants[index][1] for name, variants in guides.items()}
                found = demc.denoise(color, **own)
                self.assertEqual((found.shape, found.dtype), (color.shape, color.dtype))
                self.assertEqual(planar(found).tobytes(), self.clean.tobytes())

    def test_half_gives_half(self) -> None:
        halves = {name: guide.astype(np.float16) for name, guide in self.guides.items()}
        color = self.small.astype(np.float16)
        found = demc.denoise(color, **halves)
        self.assertEqual(found.dtype, np.float16)
        floats = {name: half.astype(np.float32) for name, half in halves.items()}
        expected = demc.denoise(color.astype(np.float32), **floats).astype(np.float16)
        self.assertEqual(found.tobytes(), expected.tobytes())

    def test_limits_of_half_cause_a_warning(self) -> None:
        out = np.empty((3, 64, 96), np.float16)
        with self.assertWarnsRegex(demc.DemcWarning, "samples above 65504, the maximum of float16, are written as 65504"):
            self.denoise(self.small * np.float32(1e7), out=out)
        self.assertEqual(out.max(), 65504)

    def test_an_output_is_written_in_place(self) -> None:
        pixels = np.zeros((64, 96, 4), np.float32)
        pixels[..., :3] = self.small.transpose(1, 2, 0)
        pixels[..., 3] = 7
        view = pixels[..., :3]
        self.assertIs(self.denoise(view, out=view), view)
        self.assertEqual(view.transpose(2, 0, 1).tobytes(), self.clean.tobytes())
        self.assertTrue((pixels[..., 3] == 7).all())

    def test_three_rows_of_three_pixels_are_pixels(self) -> None:
        color = np.random.default_rng(1).random((3, 5, 3), np.float32)
        guides = {"normal": np.full_like(color, 0.577), "albedo": np.full_like(color, 0.5)}
        found = demc.denoise(color, **guides)
        expected = demc.denoise(color.transpose(2, 0, 1).copy(), **{name: x.transpose(2, 0, 1).copy() for name, x in guides.items()})
        self.assertEqual(found.transpose(2, 0, 1).tobytes(), expected.tobytes())

    def test_memory_is_cut_into_tiles_with_the_same_result(self) -> None:
        whole = demc.denoise(self.color, **self.features)
        tiled = demc.denoise(self.color, memory=60, **self.features)
        np.testing.assert_allclose(tiled, whole, rtol=1e-4, atol=1e-5)


class Refusals(Native):
    def test_types(self) -> None:
        self.refused(TypeError, "color is uint8: give linear radiance as float32, for example ((image / 255) ** 2.2)", np.uint8(self.small))
        self.refused(TypeError, "color is uint16: give linear radiance as float32, for example ((image / 65535)", np.uint16(self.small))
        self.refused(TypeError, 'color is float64: expected float32 or float16; convert it with .astype("float32")', np.float64(self.small))
        self.refused(TypeError, "color is int64", np.int64(self.small))
        self.refused(TypeError, "color is complex64", np.complex64(self.small))
        self.refused(TypeError, "color is bool", self.small > 1)
        self.refused(TypeError, "color is object", None)
        self.refused(TypeError, 'color has another byte order than this machine: convert it with .astype("float32")', self.small.astype(">f4"))
        self.refused(TypeError, "normal is uint8: expected float32", self.small, normal=np.uint8(self.small))
        self.refused(TypeError, "color is float64", self.small.tolist())

    def test_shapes(self) -> None:
        expected = "expected (height, width, 3) or (3, height, width)"
        for shape in ((64, 96), (64, 96, 4), (4, 64, 96), (1, 3, 64, 96), (), (3,)):
            self.refused(ValueError, f"color has the shape {shape}: {expected}", np.ones(shape, np.float32))
        self.refused(demc.DemcError, "normal has 64x95 pixels, but color has 64x96", self.small, normal=self.small[..., 1:])
        self.refused(demc.DemcError, "alpha has 96x64 pixels", self.small, alpha=np.ones((96, 64), np.float32))
        self.refused(ValueError, "alpha has the shape (64, 96, 1)", self.small, alpha=np.ones((64, 96, 1), np.float32))
        for shape, size in (((3, 0, 96), "96x0"), ((3, 64, 0), "0x64"), ((0, 64, 3), "64x0"), ((0, 0, 3), "0x0")):
            self.refused(demc.DemcError, f"color: its size is {size}, not 1x1 to", np.ones(shape, np.float32))
        wide = np.lib.stride_tricks.as_strided(np.ones(1, np.float32), (3, 1, 32769), (0, 0, 0))
        self.refused(demc.DemcError, "color: its size is 32769x1", wide, out=np.empty((3, 1, 32769), np.float32))

    def test_samples(self) -> None:
        for name in ("color", *FEATURES, "alpha"):
            image = np.full((3, 64, 96), 0.5, np.float32)
            image[:, 5, 7] = np.nan
            value = image[0] if name == "alpha" else image
            count = 1 if name == "alpha" else 3
            options = {"color": self.small, name: value}
            self.refused(demc.DemcError, f"{name} has {count} NaN or infinite sample(s)", options.pop("color"), **options)
        far = self.guides["albedo"] * 1e4
        self.refused(demc.DemcError, "does not fit the model's statistics", self.small, normal=far)

    def test_absent_arrays(self) -> None:
        self.refused(demc.DemcError, "no normal, which this model needs", self.small, normal=None)
        self.refused(demc.DemcError, "no albedo, which this model needs", self.small, albedo=None)

    def test_outputs(self) -> None:
        frozen = self.small.copy()
        frozen.flags.writeable = False
        self.refused(ValueError, "out is read-only", self.small, out=frozen)
        self.refused(ValueError, "out has the shape (3, 64, 95): expected (3, 64, 96)", self.small, out=self.small[..., 1:].copy())
        self.refused(TypeError, "out is float64", self.small, out=np.float64(self.small))
        self.refused(TypeError, "out is list: expected a NumPy array", self.small, out=[])
        shared = np.lib.stride_tricks.as_strided(self.small.copy(), self.small.shape, (0, 4, 4))
        self.refused(ValueError, "out: samples of the output share memory", self.small, out=shared)

    def test_options(self) -> None:
        self.refused(demc.DemcError, "the number of passes must be 1, 4 or 8", self.small, passes=2)
        for scale in (0, -1, np.nan, np.inf):
            self.refused(demc.DemcError, "input_scale must be positive and finite", self.small, input_scale=scale)
        self.refused(ValueError, "layer key has the shape (2, 64, 96)", self.small, layers={"key": self.small[:2]})
        self.refused(TypeError, "layer key is float64", self.small, layers={"key": np.float64(self.small)})

    def test_models(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "x.safetensors")
            with self.assertRaisesRegex(FileNotFoundError, "x.safetensors"):
                demc.Model.load(path)
            model = (ROOT / "models" / "quality.safetensors").read_bytes()
            for data, text in [
                (b"", "x.safetensors"),
                (model[:1000], "x.safetensors"),
                (model[:-100], "x.safetensors"),
                (model[:-4] + b"abcd", "checksum"),
                (model.replace(rb'\"format\":1', rb'\"format\":9', 1), "format 9"),
            ]:
                path.write_bytes(data)
                with self.assertRaisesRegex(demc.DemcError, text) as caught:
                    demc.denoise(self.small, model=path, **self.guides)
                self.assertNotIn("\n", str(caught.exception))

    def test_weights_of_open_image_denoise(self) -> None:
        package = importlib.util.find_spec("pyoidn")
        if package is None and os.environ.get("DEMC_REQUIRE_WHEEL") != "1":
            self.skipTest("no pyoidn")
        (folder,) = package.submodule_search_locations
        library = next(Path(folder).rglob("libOpenImageDenoise_core.so.*"))
        with tempfile.TemporaryDirectory() as folder:
            own, other = Path(folder, "own.safetensors"), Path(folder, "other.safetensors")
            model = demc.import_oidn(library, own, weights="rt_hdr_alb")
            arguments = ["import", "--oidn", library, "--weights", "rt_hdr_alb", "-o", other]
            subprocess.run([program("demc-infer"), *arguments], check=True, capture_output=True)
            self.assertEqual(own.read_bytes(), other.read_bytes())
            self.assertEqual(model.required, ("albedo",))
            clean = model.denoise(self.small, albedo=self.guides["albedo"])
            # Guides that the network does not take change nothing.
            np.testing.assert_array_equal(clean, model.denoise(self.small, **self.guides))
            with self.assertRaisesRegex(demc.DemcError, "own.safetensors"):
                demc.import_oidn(library, own)
            with self.assertRaisesRegex(demc.DemcError, "no weights `none`; it has .*rt_hdr_alb_nrm"):
                demc.import_oidn(library, own, weights="none", overwrite=True)

    def test_warnings_name_the_caller(self) -> None:
        with self.assertWarnsRegex(demc.DemcWarning, "normal: its length is") as caught:
            demc.denoise(self.small, **{**self.guides, "normal": self.guides["normal"] * 3})
        self.assertEqual(caught.filename, __file__)


class Callbacks(Native):
    def test_progress_rises_to_one(self) -> None:
        shares = []
        self.denoise(self.small, on_progress=shares.append)
        self.assertEqual((shares, shares[-1]), (sorted(shares), 1))

    def test_an_exception_stops_the_work(self) -> None:
        shares = []

        def stop(share: float) -> None:
            shares.append(share)
            raise Interruption("enough")

        with self.assertRaisesRegex(Interruption, "enough"):
            demc.denoise(self.color, on_progress=stop, **self.features)
        self.assertEqual(shares, [0])
        self.assertEqual(self.denoise(self.small).tobytes(), self.clean.tobytes())

    def test_a_callback_may_denoise(self) -> None:
        found = []
        self.denoise(self.small, on_progress=lambda share: found or found.append(self.denoise(self.small)))
        self.assertEqual(found[0].tobytes(), self.clean.tobytes())

    def test_other_threads_run_meanwhile(self) -> None:
        counted, done = [], threading.Event()

        def count() -> None:
            while not done.is_set():
                counted.append(time.perf_counter())

        counter = threading.Thread(target=count)
        counter.start()
        start = time.perf_counter()
        demc.denoise(self.color, **self.features)
        end = time.perf_counter()
        done.set()
        counter.join()
        # A held GIL would leave a gap of the whole call.
        times = [start, *(moment for moment in counted if start < moment < end), end]
        self.assertLess(max(b - a for a, b in zip(times, times[1:])), 0.5 * (end - start))

    def test_several_threads_denoise_at_the_same_time(self) -> None:
        results = []
        work = lambda: results.append(self.denoise(self.small, on_progress=lambda share: None).tobytes())
        threads = [threading.Thread(target=work) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self.assertEqual(results, [self.clean.tobytes()] * 6)

    def test_a_single_thread_suffices(self) -> None:
        script = (
            "import demc, numpy as np\n"
            "x = np.full((32, 32, 3), 0.5, 'f4')\n"
            "inner = lambda share: demc.denoise(x, normal=x, albedo=x)\n"
            "print(demc.denoise(x, normal=x, albedo=x, on_progress=inner).shape)\n"
        )
        environment = os.environ | {"RAYON_NUM_THREADS": "1"}
        command = [sys.executable, "-W", "ignore", "-c", script]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
        self.assertEqual(done.stdout, "(32, 32, 3)\n", done.stderr)

    def test_an_unknown_instruction_set_is_refused(self) -> None:
        script = "import demc\ntry: demc.Model()\nexcept demc.DemcError as error: print(error)"
        environment = os.environ | {"DEMC_ISA": "sse9"}
        done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
        self.assertRegex(done.stdout, "DEMC_ISA: .*sse9")

    def test_calls_leave_no_memory_behind(self) -> None:
        resident = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if not Path("/proc/self/statm").exists():
            self.skipTest("no /proc")

        def often(count: int) -> None:
            for _ in range(count):
                self.denoise(self.small)
                with self.assertRaises(demc.DemcError):
                    self.denoise(self.small, normal=self.small * np.nan)
                with self.assertRaises(Interruption):
                    self.denoise(self.small, on_progress=self.interrupt)

        often(20)
        before = resident()
        often(200)
        self.assertLess(resident() - before, 8 << 20)

    @staticmethod
    def interrupt(_share: float) -> None:
        raise Interruption

    def test_a_forked_child_gets_an_error_instead_of_waiting(self) -> None:
        if "fork" not in multiprocessing.get_all_start_methods():
            self.skipTest("no fork")
        fork = multiprocessing.get_context("fork")
        results = fork.Queue()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            child = fork.Process(target=denoise_in_child, args=(results,))
            child.start()
        self.assertIn('the method "spawn"', results.get(timeout=60))
        child.join()


if __name__ == "__main__":
    unittest.main()
