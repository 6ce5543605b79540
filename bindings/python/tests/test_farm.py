"""Tests of what farms need: shards, whole files, and the Open Job Description template.

The template runs with `openjd` and `demc-infer` on the `PATH`. Without these its test is skipped,
unless DEMC_REQUIRE_OPENJD=1.
"""

import argparse
import contextlib
import io
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
ROOT = PACKAGE.parents[1]
TEMPLATE = ROOT / "configs" / "cluster" / "openjd" / "denoise.yaml"
IMAGE = ROOT / "data" / "sample" / "test" / "gen-table-test-1.exr"
MISSING = [name for name in ("openjd", "demc-infer") if shutil.which(name) is None]

sys.path.insert(0, str(PACKAGE))

from demc.torch.files import ABANDONED, replacing, write_text
from demc.torch.shard import Shard, add_shard_flag


def write_often(path: Path, letter: str) -> None:
    for _ in range(50):
        write_text(path, letter * 100_000)


class Shards(unittest.TestCase):
    def test_shards_share_out_the_names_in_order(self) -> None:
        keep = lambda text: sorted(Shard.parse(text).keep("dbace"))
        self.assertEqual(keep("1/2"), ["a", "c", "e"])
        self.assertEqual(keep("2/2"), ["b", "d"])
        self.assertEqual(keep("7/7"), [])

    def test_a_shard_counts_from_1(self) -> None:
        parser = argparse.ArgumentParser()
        add_shard_flag(parser, "views")
        for wrong in ("0/4", "5/4", "0/0", "x", "1", "1/", "/4", "-1/4", "1/4/4", "1.5/4", "", "1/4\n"):
            with self.assertRaises(SystemExit), contextlib.redirect_stderr(io.StringIO()) as told:
                parser.parse_args([f"--shard={wrong}"])
            self.assertIn("expected I/N with I from 1 to N, such as 1/4", told.getvalue())
        self.assertEqual(parser.parse_args(["--shard", "4/4"]).shard, Shard(4, 4))


class Files(unittest.TestCase):
    def test_a_file_is_whole_also_with_two_writers(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.txt"
            writers = [multiprocessing.Process(target=write_often, args=(path, letter)) for letter in "ab"]
            for writer in writers:
                writer.start()
            while any(writer.is_alive() for writer in writers):
                if path.exists():
                    self.assertIn(path.read_text(), ("a" * 100_000, "b" * 100_000))
            self.assertEqual([writer.exitcode for writer in writers], [0, 0])
            self.assertEqual(os.listdir(folder), ["a.txt"])

    def test_an_error_leaves_nothing_and_old_leftovers_are_removed(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "[a].txt"
            path.write_text("before")
            old, new = (path.with_name(f".{path.name}.{name}.unfinished") for name in ("old", "new"))
            for left in (old, new):
                left.write_text("half")
            os.utime(old, (old.stat().st_mtime - ABANDONED - 60,) * 2)
            with self.assertRaises(OSError), replacing(path) as unfinished:
                unfinished.write_text("half")
                raise OSError
            self.assertEqual(path.read_text(), "before")
            self.assertEqual(sorted(os.listdir(folder)), [new.name, path.name])


@unittest.skipIf(MISSING and os.environ.get("DEMC_REQUIRE_OPENJD") != "1", f"no {', '.join(MISSING)}")
class Template(unittest.TestCase):
    def openjd(self, **parameters: object) -> subprocess.CompletedProcess:
        pairs = [argument for name, value in parameters.items() for argument in ("-p", f"{name}={value}")]
        command = ["openjd", "run", TEMPLATE, *pairs]
        return subprocess.run(command, capture_output=True, text=True)

    def test_chunks_denoise_a_sequence_and_a_failed_task_fails_the_job(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for number in (1, 2, 3, 4, 6, 7):
                shutil.copy(IMAGE, Path(folder) / f"shot.{number:04}.exr")
            job = {"Input": f"{folder}/shot.####.exr", "Output": f"{folder}/out", "ChunkSize": 3}
            # The last chunk, 6-8, ends after the sequence.
            ended = self.openjd(Frames="1-4:2,6-8", **job)
            self.assertEqual(ended.returncode, 0, ended.stdout)
            self.assertIn("1 of 3 chosen frames are after its last one, 7", ended.stdout)
            made = [f"shot.{number:04}.exr" for number in (1, 3, 6, 7)]
            self.assertEqual(sorted(os.listdir(f"{folder}/out")), made)
            ended = self.openjd(Frames="4-6", **job)
            self.assertNotEqual(ended.returncode, 0)
            self.assertIn("1 of 3 frames are missing: 5", ended.stdout)
