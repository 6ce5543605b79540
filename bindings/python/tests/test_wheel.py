"""Tests of the newest wheel in dist/ in a new virtual environment, with a `PATH` without Rust.

`pip wheel --no-deps ./bindings/python --wheel-dir dist` makes the wheel. Without it the tests are skipped, unless
DEMC_REQUIRE_WHEEL=1.
"""

import os
import subprocess
import sys
import tempfile
import unittest
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
WHEELS = sorted((ROOT / "dist").glob("demc-*.whl"), key=lambda path: path.stat().st_mtime)
SCRIPT = """
import demc, numpy as np
color = np.full((48, 64, 3), 0.5, np.float32)
print(demc.denoise(color, normal=color, albedo=color).shape, demc.Model.load().name)
print(demc.torch.layouts.preset("cycles").name)
"""


@unittest.skipIf(not WHEELS and os.environ.get("DEMC_REQUIRE_WHEEL") != "1", "no wheel in dist")
class Wheel(unittest.TestCase):
    def setUp(self) -> None:
        self.wheel = WHEELS[-1]

    def test_one_wheel_serves_all_versions_and_has_licences_types_and_programs(self) -> None:
        self.assertIn("-cp311-abi3-", self.wheel.name)
        with zipfile.ZipFile(self.wheel) as archive:
            names = archive.namelist()
            [scripts] = (archive.read(name).decode() for name in names if name.endswith("entry_points.txt"))
        ends = {name.rpartition("/")[2] for name in names}
        self.assertLessEqual({"LICENSE-MIT", "LICENSE-APACHE", "py.typed", "_native.pyi"}, ends)
        for name in ("demc-infer", "demc-data", "demc-train"):
            self.assertIn(f"{name}=demc.programs:", scripts)
        self.assertEqual({name.partition("/")[0] for name in names if not name.startswith("demc-")}, {"demc"})

    def test_a_new_environment_without_rust_denoises(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            programs = Path(folder, "venv", "bin")
            environment = {name: value for name, value in os.environ.items() if not name.startswith(("CARGO", "RUST", "PYTHON"))}
            environment["PATH"] = f"{programs}:/usr/bin:/bin"
            environment["HOME"] = folder

            def succeed(*command: object) -> str:
                done = subprocess.run([*map(str, command)], cwd=folder, env=environment, capture_output=True, text=True)
                self.assertEqual(done.returncode, 0, done.stderr)
                return done.stdout

            succeed(sys.executable, "-m", "venv", programs.parent)
            succeed(programs / "pip", "install", "-q", "--only-binary=:all:", self.wheel)
            output = succeed(programs / "python", "-W", "ignore", "-c", SCRIPT)
            self.assertEqual(output, "(48, 64, 3) quality\ncycles\n")
            for name in ("demc-infer", "demc-data", "demc-train"):
                self.assertIn("Usage:", succeed(programs / name, "--help"))
            image = ROOT / "data" / "sample" / "test" / "gen-table-test-1.exr"
            succeed(programs / "demc-infer", "denoise", image, "-o", Path(folder, "x.exr"))


if __name__ == "__main__":
    unittest.main()
