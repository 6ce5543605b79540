"""Outputs: what they may replace, their names, permissions, leftovers, and when they are checked."""
import fcntl
import os
import shutil
import stat

import common
from common import Attack
import outputs

DEAD = 4199999999  # Above the largest process id.


def temporary(name, process):
    """What a process of this computer calls the file while it writes it (`demc_program::file`)."""
    with open("/proc/sys/kernel/random/boot_id") as boot:
        host = f"{boot.read(8)}-{os.stat('/proc/self/ns/pid').st_ino}"
    return f".{name}.{host}-{process}.tmp"


class Outputs(Attack):
    def setUp(self):
        super().setUp()
        outputs.prepare(self.root)
        self.outputs = outputs.outputs(self.root)

    def one_of_each(self):
        """The first output of each verb; in the long form, all outputs."""
        verbs = {}
        for output in self.outputs:
            verbs.setdefault(output.name.split(",")[0], output)
        return self.outputs if common.LONG else verbs.values()

    def run_output(self, output, path=None, *more, **options):
        """Writes `path`, whose directory exists."""
        path = output.file if path is None else path
        if output.fixed:
            self.make_place(output, path)
        return self.run_program(*output.arguments(path), *more, **options)

    def make_place(self, output, path):
        """Makes the directory of an output with a fixed name."""
        folder = self.root / os.fsdecode(os.path.dirname(path))
        folder.mkdir(parents=True, exist_ok=True)
        if output.name == "index" and not (folder / "scene.exr").exists():
            shutil.copy(self.root / "bare" / "scene.exr", folder)
        return folder

    def one_line(self, result, code, *words):
        """The program ended with `code` and one line of error."""
        self.assertEqual(result.code, code, result)
        errors = [line for line in result.stderr.splitlines() if not line.startswith(("note:", "warning:"))]
        self.assertEqual(len(errors), 1, result)
        for word in words:
            self.assertIn(word, errors[0], result)

    def test_01_no_output_replaces_an_input(self):
        aliases = {
            "same": lambda source, _: source,
            "roundabout": lambda source, _: f"data/../{source}",
            "symlink": lambda source, alias: (alias.symlink_to(self.root / source), alias.relative_to(self.root))[1],
            "hard link": lambda source, alias: (os.link(self.root / source, alias), alias.relative_to(self.root))[1],
        }
        for output in self.outputs:
            for number, source in enumerate(output.inputs):
                any_name = not output.fixed and source.endswith(output.suffix)
                kinds = list(aliases) if any_name else ["symlink", "hard link"]
                for kind in kinds if common.LONG else [kinds[number % len(kinds)]]:
                    with self.subTest(output=output.name, input=source, alias=kind):
                        self.refuses(output, source, aliases[kind])

    def refuses(self, output, source, alias_of):
        """The output that is another path of `source` is refused, and no file changes."""
        self.make_place(output, output.file)
        alias = self.root / output.file
        path = str(alias_of(source, alias))
        try:
            before = outputs.contents(self.root)
            more = ["--overwrite"] * output.overwrite
            self.one_line(self.run_output(output, path, *more), 2, "would replace")
            self.assertEqual(outputs.contents(self.root), before)
        finally:
            if path == output.file:
                alias.unlink()

    def test_01_inputs_of_denoise_are_kept_in_a_directory(self):
        for name in ("a.exr", "b.exr"):
            shutil.copy(self.root / "frame.exr", self.root / "baseline" / name)
        before = outputs.contents(self.root)
        for target in (".", "data/..", "link"):
            if target == "link":
                (self.root / "link").symlink_to("baseline")
            source = "baseline" if target == "link" else "frame.exr"
            result = self.run_program("demc-infer", "denoise", source, "-o", target, "--overwrite")
            self.one_line(result, 2, "would replace")
        self.assertEqual({p: b for p, b in outputs.contents(self.root).items() if "link" not in p.parts}, before)

    def test_02_an_existing_file_needs_overwrite(self):
        for output in self.outputs:
            if not output.overwrite:
                continue
            with self.subTest(output=output.name):
                path = self.root / output.file
                path.write_bytes(b"mine")
                self.one_line(self.run_output(output), 2, path.name, "exists", "--overwrite replaces it")
                self.assertEqual(path.read_bytes(), b"mine")
                if output.name != "index":
                    result = self.run_output(output, None, "--overwrite")
                    self.assertEqual(result.code, 0, result)
                    self.assertNotEqual(path.read_bytes(), b"mine")
                for made in self.root.glob(f"{path.stem}.*"):
                    made.unlink()

    def test_02_previews(self):
        denoise = ["demc-infer", "denoise", "--model", "model.safetensors", "--png"]
        for name in ("pin.png", "pc.png"):
            shutil.copy(self.root / "frame.exr", self.root / name)
        before = outputs.contents(self.root)
        self.one_line(self.run_program(*denoise, "pin.png", "-o", "pin.exr"), 2, "pin.png would replace the input")
        (self.root / "pc.png").unlink()
        self.one_line(self.run_program(*denoise, "frame.exr", "-o", "pc.png"), 2, "an output is an EXR file")
        self.one_line(self.run_program(*denoise, "frame.exr", "pin.png", "-o", "pin.png", "--overwrite"), 2)
        self.assertEqual(outputs.contents(self.root), {p: b for p, b in before.items() if p.name != "pc.png"})
        # In a directory, what another program made is kept, and reported.
        out = self.root / "out"
        out.mkdir()
        (out / "frame.png").write_bytes(b"mine")
        result = self.run_program(*denoise, "frame.exr", "-o", "out")
        self.assert_refused(result, "frame.png exists, not written by this program; --overwrite replaces it")
        self.assertEqual((out / "frame.png").read_bytes(), b"mine")
        self.assertTrue((out / "frame.exr").is_file())
        (out / "frame.png").unlink()
        (out / "frame.exr").write_bytes(b"mine")
        result = self.run_program(*denoise, "frame.exr", "-o", "out")
        self.assert_refused(result, "frame.exr exists, damaged, or not an EXR file; --overwrite replaces it")
        self.assertEqual((out / "frame.exr").read_bytes(), b"mine")
        self.assertFalse((out / "frame.png").exists())

    def test_03_outputs_keep_their_bytes(self):
        for output in self.one_of_each():
            with self.subTest(output=output.name):
                folder, name = os.path.split(os.fsencode(output.file))
                path = os.path.join(b"f\xff", name) if output.fixed else b"n\xff" + name
                result = self.run_output(output, path, *["--overwrite"] * output.overwrite)
                exists = os.path.exists(os.path.join(os.fsencode(self.root), path))
                if result.code == 0:
                    self.assertTrue(exists, result)
                else:
                    self.one_line(result, 2, "not UTF-8")
                    self.assertFalse(exists, result)
                changed = [p for p in self.root.rglob("*") if "\ufffd" in p.name]
                self.assertEqual(changed, [])

    def test_03_run_directories_and_inputs(self):
        bad = os.fsencode(self.root) + b"/d\xff"
        os.mkdir(bad)
        for name in ("frame.exr", "tiny.toml", "model.safetensors"):
            shutil.copy(os.fsencode(self.root / name), bad + b"/" + os.fsencode(name))
        os.mkdir(os.fsencode(self.root) + b"/d\xef\xbf\xbd")
        shutil.copy(self.root / "frame.exr", os.fsencode(self.root) + b"/d\xef\xbf\xbd/wrong.exr")
        tiny = ["demc-train", "--config", "tiny.toml"]
        refused = [
            [*tiny, "--run-dir", b"x\xff"],
            [*tiny, "--run-dir", b"x\xff", "--check"],
            ["demc-train", "--config", b"d\xff/tiny.toml", "--run-dir", b"x\xfe"],
            ["demc-train", "ablate", "--config", "ablation.toml", "--run-dir", b"x\xff"],
            ["demc-infer", "denoise", b"d\xff/*.exr", "-o", "out/"],
            ["demc-infer", "check", "--json", b"d\xff/frame.exr"],
            ["demc-infer", "inspect", "--json", "--model", b"d\xff/model.safetensors"],
            ["demc-data", "merge", b"x=d\xff/frame.exr", "-o", "out.exr"],
        ]
        before = outputs.contents(self.root)
        for command in refused:
            with self.subTest(command=command):
                self.one_line(self.run_program(*command), 2, "UTF-8")
                self.assertEqual(outputs.contents(self.root), before)
        # Relative paths of a configuration start in the current directory.
        for path in ("data", "init", "layout"):
            sets = {"data": [], "init": ["--set", "train.init=model.safetensors"],
                    "layout": ["--set", "data.layout=l.toml"]}[path]
            program = [str(common.PROGRAMS / "demc-train"), "--config", "tiny.toml", *sets, "--run-dir", "/tmp/x"]
            self.one_line(common.run("demc-train", *program[1:], cwd=bad), 2, "UTF-8")
        allowed = [
            ["demc-infer", "denoise", b"d\xff/frame.exr", "-o", b"d\xff/out.exr",
             "--model", b"d\xff/model.safetensors"],
            ["demc-infer", "denoise", b"d\xff", "-o", "out/", "--model", "model.safetensors"],
            ["demc-data", "merge", b"d\xff/frame.exr", "-o", b"d\xff/merged.exr"],
        ]
        for command in allowed:
            with self.subTest(command=command):
                result = self.run_program(*command)
                self.assertEqual(result.code, 0, result)
        self.assertTrue((self.root / "out" / "frame.exr").is_file())

    def test_11_umask_and_old_modes(self):
        mode = lambda path: stat.S_IMODE(os.stat(path).st_mode)
        for output in self.one_of_each():
            if output.name == "train, best":
                continue  # Without validation scenes, it is not written.
            path = self.root / output.file
            for mask in (0o002, 0o022, 0o077) if common.LONG else (0o077,):
                with self.subTest(output=output.name, umask=oct(mask)):
                    if output.name.startswith("train"):
                        shutil.rmtree(path.parent, ignore_errors=True)
                    path.unlink(missing_ok=True)
                    if output.name == "denoise --png":
                        (self.root / "out.exr").unlink(missing_ok=True)
                    result = self.run_output(output, umask=mask)
                    self.assertEqual(result.code, 0, result)
                    self.assertEqual(oct(mode(path)), oct(0o666 & ~mask), result)
            if output.name.startswith("train"):
                loose = [p for p in path.parent.rglob("*") if p.is_file() and mode(p) & 0o077]
                self.assertEqual(loose, [])
                continue
            with self.subTest(output=output.name, replaced=True):
                path.chmod(0o640)
                more = ["--overwrite"] * output.overwrite
                before = path.stat().st_ino
                result = self.run_output(output, None, *more, umask=0o022)
                self.assertEqual(result.code, 0, result)
                self.assertNotEqual(path.stat().st_ino, before)
                self.assertEqual(oct(mode(path)), oct(0o640), result)

    def test_12_leftovers_of_dead_processes(self):
        for output in self.one_of_each():
            with self.subTest(output=output.name):
                path = self.root / output.file
                folder = self.make_place(output, output.file)
                stale = folder / temporary(path.name, DEAD)
                other = folder / temporary("mine", DEAD)
                living = folder / temporary(path.name, os.getpid())
                locked = folder / temporary(path.name, DEAD - 1)
                elsewhere = folder / f".{path.name}.0badc0de-1-{DEAD}.tmp"
                for file in (stale, other, living, locked, elsewhere):
                    file.write_bytes(b"half")
                more = ["--overwrite"] * output.overwrite
                with open(locked, "rb+") as lock:
                    fcntl.flock(lock, fcntl.LOCK_EX)
                    result = self.run_output(output, None, *more)
                self.assertEqual(result.code, 0, result)
                self.assertFalse(stale.exists())
                self.assertTrue(living.exists() and locked.exists() and elsewhere.exists())
                if not output.name.startswith("train"):
                    self.assertTrue(other.exists())
                if output.name.startswith("train"):
                    shutil.rmtree(folder)

    def test_13_outputs_are_checked_before_the_work(self):
        # Pixels cannot be read, so a program that starts to work fails with another message.
        damaged = [*self.root.glob("data/*/*.exr"), self.root / "frame.exr", *self.root.glob("bare/*.exr")]
        for file in damaged:
            data = bytearray(file.read_bytes())
            data[len(data) // 2:] = bytes(len(data) - len(data) // 2)
            file.write_bytes(data)
        (self.root / "file").write_bytes(b"")
        (self.root / "protected").mkdir()
        for number, output in enumerate(self.outputs):
            if output.name.startswith(("train", "index")):
                continue
            ending, name = output.suffix, os.path.basename(output.file)
            places = {"a file as directory": f"file/{name}"}
            if not output.directory:
                places["no directory"] = f"missing/{name}"
            if not output.fixed:
                places["a directory"] = f"taken{number}{ending}"
                (self.root / f"taken{number}{ending}").mkdir()
                places["a long name"] = f"{'n' * 250}{ending}"
                places["a link to nothing"] = f"dangling{ending}"
                dangling = self.root / f"dangling{ending}"
                if not dangling.is_symlink():
                    dangling.symlink_to("nothing")
                places["a FIFO"] = f"fifo{ending}"
                if not (self.root / f"fifo{ending}").exists():
                    os.mkfifo(self.root / f"fifo{ending}")
            places["no permission"] = f"protected/{name}"
            for order, (problem, path) in enumerate(places.items()):
                if (number + order) % 2 and not common.LONG:
                    continue  # The short form tries every problem with every other output.
                if problem == "a directory" and output.name.startswith("denoise") and not output.ending:
                    continue  # It gets the image.
                with self.subTest(output=output.name, problem=problem):
                    options = {}
                    if problem == "no permission":
                        options = self.without_permission()
                    more = ["--overwrite"] * output.overwrite
                    result = self.run_program(*output.arguments(path), *more, **options)
                    self.one_line(result, 1, "cannot write")
                    self.assertEqual(list(self.root.rglob(".*.tmp")), [])

    def without_permission(self):
        """Takes the permission to write `protected` from the program, also for root."""
        (self.root / "protected").chmod(0o555)
        if os.geteuid() != 0:
            return {}
        for folder in (self.root.parent, self.root):
            folder.chmod(0o755)
        return {"user": 65534, "group": 65534}
