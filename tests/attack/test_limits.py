"""Limits, memory, streams, and names: items 7, 8, 9, 14, 15, 16, and 17."""
import json
import os
import re
import resource
import shutil
import struct
import unittest

from common import LONG, Attack

HOSTILE = "a\x1b[2J\x9b31m\nZq"
# Control characters that a terminal obeys; a line break is one only within a name.
CONTROLS = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e]")
HUGE = [0, 1, -1, 31, 2**15 + 1, 2**31, 2**32 - 1, 2**32, 2**63 - 1, 2**63, 2**64 - 32, 2**64 - 1, 2**64, 10**30]


def attribute(name, kind, value):
    return name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value


def exr(width, height, channels, pixels=0):
    """An uncompressed EXR file of half channels, each row with `pixels` instead of the samples' bytes."""
    listed = b"".join(name + b"\0" + struct.pack("<i4xii", 1, 1, 1) for name in sorted(channels)) + b"\0"
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    head = b"\x76\x2f\x31\x01\x02\0\0\0" + attribute(b"channels", b"chlist", listed)
    head += attribute(b"compression", b"compression", b"\0")
    head += attribute(b"dataWindow", b"box2i", window) + attribute(b"displayWindow", b"box2i", window)
    head += attribute(b"lineOrder", b"lineOrder", b"\0")
    head += attribute(b"pixelAspectRatio", b"float", struct.pack("<f", 1))
    head += attribute(b"screenWindowCenter", b"v2f", struct.pack("<ff", 0, 0))
    head += attribute(b"screenWindowWidth", b"float", struct.pack("<f", 1)) + b"\0"
    row = pixels or 2 * width * len(channels)
    start = len(head) + 8 * height
    table = b"".join(struct.pack("<Q", start + y * (8 + row)) for y in range(height))
    # 0x3800 is 0.5: normals, positions, and colours that no check refuses.
    line = b"\0\x38" * (row // 2)
    return head + table + b"".join(struct.pack("<ii", y, row) + line for y in range(height))


class Limits(Attack):
    def large(self, name, width, height):
        """A frame with the channels of frame.exr and another size."""
        listed = json.loads(self.run_program("demc-data", "inspect", "--json", "frame.exr").stdout)
        channels = [c["name"].encode() for c in listed[0]["channels"]]
        (self.root / name).write_bytes(exr(width, height, channels))

    # 7: integers of every verb

    def test_07_integers_neither_wrap_nor_panic(self):
        """Every integer option of every verb, with every value that is near a limit of a type."""
        denoise = ["demc-infer", "denoise", "frame.exr", "-o", "out.exr", "--overwrite", "--memory", "200"]
        cost = ["demc-infer", "cost", "--size", "640x480"]
        cases = [(cost, option) for option in ("--halo", "--tile", "--memory")]
        cases += [(["demc-infer", "cost"], "--size"), (["demc-data", "doctor", "data"], "--patch-size")]
        cases += [(["demc-infer", "check", "frame.##.exr"], "--frames"), (cost[:2] + ["frame.exr"], "--ensemble")]
        cases += [(["demc-train", "find-lr", "--config", "absent.toml"], "--steps")]
        for command, option in cases:
            for value in HUGE:
                text = f"{value}x2" if option == "--size" else str(value)
                result = self.run_program(*command, f"{option}={text}", timeout=20)
                self.assertLess(len(result.stderr), 4000, result)
        for value in HUGE[-6:] if not LONG else HUGE:
            result = self.run_program(*denoise, f"--halo={value}")
            self.assertEqual(result.code, 0 if 0 <= value <= 2**15 else 2, result)

    def test_07_integer_keys_of_a_configuration(self):
        """Every integer of the resolved configuration."""
        table, keys = "", []
        for line in (self.root / "run" / "config.toml").read_text().splitlines():
            if header := re.fullmatch(r"\[(\w+)\]", line):
                table = header[1]
            elif found := re.fullmatch(r"(\w+) = \d+", line):
                keys.append(f"{table}.{found[1]}")
        self.assertGreater(len(keys), 8)
        for key in keys:
            for value in HUGE if LONG else (0, 2**63 - 1, 2**64 - 1):
                self.run_program("demc-train", "--config", "tiny.toml", "--run-dir", "new", "--check", "--set",
                                 f"{key}={value}", timeout=60)

    def test_07_a_huge_halo_is_exact(self):
        """The largest halo gives the image of the exact halo."""
        outputs = []
        for halo in ("192", "32768"):
            result = self.run_program("demc-infer", "denoise", "frame.exr", "-o", f"{halo}.exr", "--model",
                                      "model.safetensors", "--tile", "64", "--halo", halo)
            self.assertEqual(result.code, 0, result)
            outputs.append(json.loads(self.run_program("demc-data", "inspect", "--json", f"{halo}.exr").stdout))
        for a, b in zip(outputs[0][0]["channels"], outputs[1][0]["channels"]):
            self.assertAlmostEqual(a["range"]["mean"], b["range"]["mean"], delta=1e-3, msg=a["name"])

    # 8: closed and full streams

    def verbs(self):
        """Every verb that ends quickly, with its exit code."""
        (self.root / "bad.exr").write_bytes(b"no EXR file")
        infer, data, train = "demc-infer", "demc-data", "demc-train"
        return [
            (0, infer, "denoise", "frame.exr", "-o", "out/", "--overwrite"),
            (1, infer, "denoise", "frame.exr", "bad.exr", "-o", "out/", "--overwrite"),
            (None, infer, "check", "frame.exr"),
            (0, infer, "cost", "frame.exr"),
            (0, infer, "inspect"),
            (0, infer, "evaluate", "--data", "data"),
            (0, infer, "report", "--data", "data", "-o", "report.html", "--overwrite"),
            (0, infer, "export", "-o", "exported.safetensors", "--overwrite"),
            (0, data, "inspect", "frame.exr"),
            (1, data, "inspect", "bad.exr", "frame.exr"),
            (0, data, "stats", "data"),
            (None, data, "doctor", "data"),
            (0, data, "merge", "frame.exr", "-o", "merged.exr", "--overwrite"),
            (0, data, "index", "data", "--overwrite", "--test", "test/*"),
            (0, train, "--config", "tiny.toml", "--check", "--run-dir", "new"),
            (0, train, "plot", "run"),
            (2, infer, "denoise"),
            (2, data, "inspect"),
            (2, train, "--wrong"),
        ]

    def closed(self):
        """The writing end of a pipe that nobody reads."""
        read, write = os.pipe()
        os.close(read)
        return write

    def test_08_messages_may_fail(self):
        """A closed or full standard error changes neither the exit code nor the outputs."""
        for code, *command in self.verbs():
            expected = self.run_program(*command)
            if code is not None:
                self.assertEqual(expected.code, code, expected)
            for stream in (self.closed(), os.open("/dev/full", os.O_WRONLY)):
                result = self.run_program(*command, stderr=stream)
                os.close(stream)
                self.assertEqual(result.code, expected.code, (command, result))
                # The available memory and the estimated duration change.
                stdout = [re.sub(r"available .*|demc-train: .*", "", text) for text in (result.stdout, expected.stdout)]
                self.assertEqual(stdout[0], stdout[1], command)
        self.assertTrue((self.root / "out" / "frame.exr").is_file())

    def test_08_all_images_are_written(self):
        for i in range(4):
            shutil.copy(self.root / "frame.exr", self.root / f"f{i}.exr")
        (self.root / "f1.exr").write_bytes(b"no EXR file")
        pipe = self.closed()
        result = self.run_program("demc-infer", "denoise", *(f"f{i}.exr" for i in range(4)), "-o", "many/",
                                  stderr=pipe)
        os.close(pipe)
        self.assertEqual(result.code, 1, result)
        self.assertEqual(sorted(os.listdir(self.root / "many")), ["f0.exr", "f2.exr", "f3.exr"])

    def test_08_results_must_arrive(self):
        """A full standard output is an error of verbs whose result goes there; a closed one is none."""
        results = [("demc-infer", "check", "--json", "frame.exr"), ("demc-infer", "cost", "frame.exr"),
                   ("demc-infer", "inspect", "--json"), ("demc-infer", "evaluate", "--data", "data"),
                   ("demc-infer", "evaluate", "--data", "data", "--json", "-"), ("demc-data", "inspect", "frame.exr"),
                   ("demc-data", "stats", "data"), ("demc-data", "doctor", "--json", "data")]
        for command in results:
            expected = self.run_program(*command)
            pipe, full = self.closed(), os.open("/dev/full", os.O_WRONLY)
            result = self.run_program(*command, stdout=pipe)
            self.assertEqual((result.code, result.stderr), (expected.code, expected.stderr), command)
            result = self.run_program(*command, stdout=full)
            self.assert_refused(result, "cannot write to standard output")
            os.close(pipe), os.close(full)

    def test_08_a_status_may_be_lost(self):
        for command in (["demc-infer", "export", "-o", "e.safetensors", "--overwrite"],
                        ["demc-infer", "report", "--data", "data", "-o", "r.html", "--overwrite"],
                        ["demc-data", "merge", "frame.exr", "-o", "m.exr"], ["demc-train", "plot", "run"]):
            full = os.open("/dev/full", os.O_WRONLY)
            result = self.run_program(*command, stdout=full)
            os.close(full)
            self.assertEqual(result.code, 0, (command, result))

    # 9: memory

    def test_09_a_limit_on_memory_is_kept(self):
        """A large image with little address space is denoised in tiles or refused, and the next image follows."""
        self.large("large.exr", 1900, 1300)
        sizes = range(300, 1300, 100) if LONG else (300, 500, 800)
        for megabytes in sizes:
            result = self.run_program("demc-infer", "denoise", "large.exr", "frame.exr", "-o", "out/", "--overwrite",
                                      memory=megabytes << 20)
            self.assertNotIn("not a readable", result.stderr)
            if result.code == 1:
                lines = [line for line in result.stderr.splitlines() if line.startswith("error:")]
                self.assertRegex(lines[0], "memory|cannot start")
        self.assertTrue((self.root / "out" / "frame.exr").is_file())
        self.assertEqual(result.code, 0, result)

    def test_09_every_verb_with_little_memory(self):
        for megabytes in (150, 300):
            for _, *command in self.verbs():
                self.run_program(*command, memory=megabytes << 20)

    def test_09_a_batch_that_does_not_fit_is_refused(self):
        """One line before the training starts."""
        for command in (["--check"], [], ["find-lr"]):
            arguments = [*command, "--config", "tiny.toml", "--set", "data.batch_size=65536", "--set",
                         "data.patch_size=128"]
            arguments += [] if command == ["find-lr"] else ["--run-dir", "new"]
            result = self.run_program("demc-train", *arguments)
            self.assert_refused(result, "data.batch_size = 65536", "MiB")
            self.assertEqual(result.stderr.count("\n"), 1, result)
        limited = self.run_program("demc-train", "--config", "tiny.toml", "--run-dir", "new", "--check", "--set",
                                   "data.batch_size=512", "--set", "data.patch_size=128", memory=900 << 20)
        self.assert_refused(limited, "data.batch_size = 512")

    # 14: bounded work

    def timed(self, seconds, *command, **options):
        """Runs a program that may take this processor time. (A busy machine does not matter.)"""
        def spent():
            usage = resource.getrusage(resource.RUSAGE_CHILDREN)
            return usage.ru_utime + usage.ru_stime

        before = spent()
        result = self.run_program(*command, **options)
        self.assertLess(spent() - before, seconds, command)
        return result

    def test_14_the_plan_of_a_large_image_is_quick(self):
        sides = ((131072, 131072), (32768, 4096), (1, 32768), (4096, 32768), (11585, 11585))
        for width, height in sides:
            for options in ((), ("--memory", "300"), ("--memory", "300", "--halo", "0"), ("--tile", "32")):
                self.timed(8, "demc-infer", "cost", "--size", f"{width}x{height}", *options)

    def test_14_many_channels_are_read_in_linear_time(self):
        channels = [f"c{i:06}".encode() for i in range(100_000)]
        (self.root / "many.exr").write_bytes(exr(2, 2, channels))
        (self.root / "cut.exr").write_bytes(exr(2, 2, channels)[:3_000_000])
        result = self.timed(8, "demc-data", "inspect", "many.exr")
        self.assertEqual(result.code, 0, result)
        for command in (["demc-data", "inspect", "cut.exr"], ["demc-infer", "check", "many.exr"],
                        ["demc-infer", "denoise", "many.exr", "-o", "o.exr"],
                        ["demc-infer", "check", "--layout", "demc-exr", "many.exr"],
                        ["demc-infer", "check", "--layout", "cycles", "many.exr"]):
            result = self.timed(8, *command)
            self.assertEqual(result.code, 1, result)
            self.assertLess(max(map(len, result.stderr.splitlines())), 4100, result)

    def test_14_threads_are_bounded(self):
        """A number of threads that makes no sense is changed, and the program says so."""
        programs = [["demc-infer", "denoise", "frame.exr", "-o", "out.exr", "--overwrite"],
                    ["demc-data", "inspect", "frame.exr"],
                    ["demc-train", "--config", "tiny.toml", "--check", "--run-dir", "new"]]
        for command in programs:
            for threads, is_said in (("1", False), ("0", False), ("", False), ("5000", True), ("abc", True),
                                     ("-1", True), ("1" * 40, True), ("2\x1b[2J", True)):
                result = self.timed(10, *command, env={**os.environ, "RAYON_NUM_THREADS": threads})
                self.assertEqual(result.code, 0, result)
                self.assertEqual("note: RAYON_NUM_THREADS=" in result.stderr, is_said, (threads, result))
                self.assertNotRegex(result.stderr, CONTROLS)

    # 15: one limit of sizes

    def test_15_cost_and_reader_agree(self):
        """`cost` plans exactly the images that the reader takes."""
        for width, height in ((32768, 1), (32769, 1), (1, 32768), (1, 32769), (0, 5), (5, 0), (32768, 4096),
                              (32768, 4097), (2**64, 1), (2**63, 2**63)):
            result = self.run_program("demc-infer", "cost", "--size", f"{width}x{height}")
            fits = 1 <= width <= 32768 and 1 <= height <= 32768 and width * height <= 2**27
            self.assertEqual(result.code, 0 if fits else 2, result)
            if 0 < width <= 2**20 and 0 < height <= 2**20:
                # The header decides; no pixels are needed.
                (self.root / "header.exr").write_bytes(exr(width, height, [b"R"], pixels=2)[:64 * 1024 * 16])
                read = self.run_program("demc-data", "inspect", "header.exr")
                self.assertEqual("its size is" in read.stderr, not fits, read)

    # 16: what fails is named

    def test_16_check_continues_at_a_bad_file(self):
        (self.root / "bad.exr").write_bytes(b"no EXR file")
        os.symlink("absent", self.root / "link.exr")
        files = ["bad.exr", "frame.exr", "link.exr", "absent.exr"]
        result = self.run_program("demc-infer", "check", "--json", *files)
        self.assertEqual(result.code, 1, result)
        report = json.loads(result.stdout)
        self.assertEqual([entry["file"] for entry in report], files)
        self.assertEqual(["error" in entry for entry in report], [True, False, True, True])
        alone = self.run_program("demc-infer", "check", "--json", "bad.exr")
        self.assertEqual((alone.code, len(json.loads(alone.stdout))), (1, 1), alone)
        text = self.run_program("demc-infer", "check", *files)
        self.assertIn("| exposure", text.stdout)
        cost = self.run_program("demc-infer", "cost", "--json", *files)
        self.assertEqual((cost.code, len(json.loads(cost.stdout)["images"])), (1, 1), cost)

    def test_16_missing_frames_are_an_error(self):
        for number in (1, 2, 5):
            shutil.copy(self.root / "frame.exr", self.root / f"s.{number:04}.exr")
        for verb in (["check", "s.####.exr"], ["denoise", "s.%04d.exr", "-o", "out/"]):
            for frames, missing in (((), "3-4"), (("--frames", "2-7"), "3-4"), (("--frames", "1-2"), None)):
                result = self.run_program("demc-infer", *verb, *frames)
                if missing:
                    self.assert_refused(result, f"frames are missing: {missing}\n")
                else:
                    self.assertNotIn("missing", result.stderr)
            shutil.rmtree(self.root / "out", ignore_errors=True)

    def test_16_links_in_a_directory_are_reported(self):
        folder = self.root / "shots"
        folder.mkdir()
        shutil.copy(self.root / "frame.exr", folder / "good.exr")
        os.symlink("absent", folder / "dangling.exr")
        os.symlink("loop.exr", folder / "loop.exr")
        os.mkfifo(folder / "fifo.exr")
        bad = ("dangling.exr", "loop.exr", "fifo.exr")
        for inputs in ("shots", "shots/*.exr"):
            for verb in (["check", inputs], ["denoise", inputs, "-o", "out/", "--overwrite"]):
                self.assert_refused(self.run_program("demc-infer", *verb), *bad)
        self.assertTrue((self.root / "out" / "good.exr").is_file())
        self.assert_refused(self.run_program("demc-data", "index", "shots"), *bad)

    # 17: names on a terminal

    def test_17_names_cannot_control_the_terminal(self):
        """Hostile names of files, scenes, bases, directories, and arguments, in every verb."""
        shutil.copy(self.root / "frame.exr", self.root / f"{HOSTILE}.exr")
        (self.root / f"bad{HOSTILE}.exr").write_bytes(b"no EXR file")
        shutil.copytree(self.root / "data", self.root / f"data{HOSTILE}")
        path = self.root / f"data{HOSTILE}" / "manifest.json"
        manifest = json.loads(path.read_text())
        for scene in manifest["scenes"]:
            scene["name"] += HOSTILE
            scene["base"] += HOSTILE
        path.write_text(json.dumps(manifest))
        image, bad, data = f"{HOSTILE}.exr", f"bad{HOSTILE}.exr", f"data{HOSTILE}"
        shutil.copy(self.root / "model.safetensors", self.root / f"{HOSTILE}.safetensors")
        shutil.copytree(self.root / "run", self.root / f"run{HOSTILE}")
        model = f"{HOSTILE}.safetensors"
        # TOML, which is printed, keeps the line breaks of its strings.
        flat = HOSTILE.split("\n")[0]
        os.symlink(data, self.root / f"data{flat}")
        configuration = ["--config", "tiny.toml", "--run-dir", f"new{flat}", "--set", f"data.root=data{flat}"]
        commands = [
            ("demc-infer", "check", image, bad), ("demc-infer", "check", "--json", image, bad),
            ("demc-infer", "cost", image, bad), ("demc-infer", "denoise", image, bad, "-o", "out/"),
            ("demc-infer", "denoise", image, "-o", f"out{HOSTILE}/", "--tile", "64", "--halo", "32"),
            ("demc-infer", "inspect", "--model", model), ("demc-infer", "inspect", "--json", "--model", model),
            ("demc-infer", "inspect", "--model", bad), ("demc-infer", "evaluate", "--data", data),
            ("demc-infer", "evaluate", "--data", data, "--json", "-"),
            ("demc-infer", "report", "--data", data, "-o", f"r{HOSTILE}.html"),
            ("demc-infer", "export", "-o", f"e{HOSTILE}.safetensors"),
            ("demc-infer", "import", model, "-o", f"i{HOSTILE}.safetensors"),
            ("demc-infer", "check", f"{HOSTILE}.####.exr"), ("demc-infer", "check", "--layer", HOSTILE, image),
            ("demc-infer", "denoise", "--layout", HOSTILE, image, "-o", "x.exr"),
            ("demc-infer", "evaluate", "--data", "data", "--baseline", f"{HOSTILE}={data}"),
            ("demc-data", "inspect", image, bad), ("demc-data", "inspect", "--json", image, bad),
            ("demc-data", "stats", data), ("demc-data", "stats", data, "--json"), ("demc-data", "doctor", data),
            ("demc-data", "doctor", data, "--json"), ("demc-data", "index", data, "--overwrite"),
            ("demc-data", "merge", image, "-o", f"m{HOSTILE}.exr"), ("demc-data", "merge", bad, "-o", "m.exr"),
            ("demc-data", "stats", HOSTILE),
            ("demc-train", *configuration), ("demc-train", *configuration, "--resume"),
            ("demc-train", "--config", "tiny.toml", "--set", f"{HOSTILE}=1"),
            ("demc-train", "--config", HOSTILE), ("demc-train", "plot", f"run{HOSTILE}"),
            ("demc-train", "plot", f"absent{HOSTILE}"),
        ]
        for command in commands:
            result = self.run_program(*command)
            for text in (result.stdout, result.stderr):
                self.assertNotRegex(text, CONTROLS, (command, result))
                self.assertNotRegex(text, "(?m)^Zq", (command, result))

    def test_17_names_in_a_file(self):
        """Names of channels and parts."""
        hostile = b"a\x1b[2J\xc2\x9b31m\nZq"
        (self.root / "names.exr").write_bytes(exr(4, 4, [hostile, hostile + b".R", b"R", b"G", b"B"]))
        for command in (["demc-data", "inspect", "names.exr"], ["demc-data", "inspect", "--json", "names.exr"],
                        ["demc-infer", "check", "names.exr"], ["demc-data", "merge", "names.exr", "-o", "m.exr"],
                        ["demc-infer", "check", "--layout", "demc-exr", "names.exr"]):
            result = self.run_program(*command)
            for text in (result.stdout, result.stderr):
                self.assertNotRegex(text, CONTROLS, (command, result))
                self.assertNotRegex(text, "(?m)^Zq", (command, result))


if __name__ == "__main__":
    unittest.main()
