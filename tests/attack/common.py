"""What every attack needs: a small project in a temporary directory, and a way to run the programs in it.

The programs are those of target/release; DEMC_BIN names another directory.
"""
import json
import os
import pathlib
import resource
import shutil
import struct
import subprocess
import tempfile
import unittest

REPOSITORY = pathlib.Path(__file__).resolve().parents[2]
PROGRAMS = pathlib.Path(os.environ.get("DEMC_BIN", REPOSITORY / "target" / "release"))
SAMPLE = REPOSITORY / "data" / "sample"
LONG = os.environ.get("DEMC_ATTACK") == "long"
COUNTS = {}  # Item -> number of cases that ran. run.py prints it.

TINY = """
[model]
width = 2
[data]
root = "data"
batch_size = 1
patch_size = 32
stride = 96
validation = 0.0
[train]
steps = 2
[run]
dir = "run"
log_every = 1
"""


class Result:
    """Exit code, standard output, and standard error (bytes decoded with surrogates) of a program."""

    def __init__(self, code, stdout, stderr):
        self.code, self.stdout, self.stderr = code, stdout, stderr

    def __repr__(self):
        return f"exit code {self.code}\n--- stdout\n{self.stdout[-3000:]}\n--- stderr\n{self.stderr[-3000:]}"


def run(*command, cwd, memory=None, umask=None, timeout=120, **options):
    """Runs a program (`demc-infer`, `demc-train`, `demc-data`) and returns its Result.

    memory: RLIMIT_AS in bytes. umask: the umask of the program. options: those of subprocess.run, for
    example stderr (default: captured) and env.
    """
    def prepare():
        if memory is not None:
            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        if umask is not None:
            os.umask(umask)

    program = PROGRAMS / command[0]
    options = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    done = subprocess.run([program, *command[1:]], cwd=cwd, preexec_fn=prepare, timeout=timeout, **options)
    text = [(s or b"").decode("utf-8", "surrogateescape") for s in (done.stdout, done.stderr)]
    return Result(done.returncode, *text)


_TEMPLATE = None


def template():
    """A directory with `tiny.toml`, `data/` (two scenes and their manifest), `run/` (a finished run of two
    steps), `model.safetensors`, and `frame.exr`. Made once per process."""
    global _TEMPLATE
    if _TEMPLATE is None:
        _TEMPLATE = tempfile.TemporaryDirectory(prefix="demc-attack-")
        root = pathlib.Path(_TEMPLATE.name)
        manifest = json.loads((SAMPLE / "manifest.json").read_text())
        scenes = manifest["scenes"]
        chosen = [next(s for s in scenes if s["split"] == split) for split in ("train", "test")]
        for scene in chosen:
            (root / "data" / scene["file"]).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(SAMPLE / scene["file"], root / "data" / scene["file"])
        shutil.copy(root / "data" / chosen[1]["file"], root / "frame.exr")
        (root / "data" / "manifest.json").write_text(json.dumps({**manifest, "scenes": chosen}, indent=1))
        (root / "tiny.toml").write_text(TINY)
        for command in (["demc-train", "--config", "tiny.toml"],
                        ["demc-infer", "export", "--model", "run", "-o", "model.safetensors"]):
            result = run(*command, cwd=root)
            assert result.code == 0, result
    return pathlib.Path(_TEMPLATE.name)


CHANNELS = [*"RGB", *(f"{buffer}.{axis}" for buffer in ("normal", "position") for axis in "XYZ"),
            *(f"{buffer}.{color}" for buffer in ("albedo1", "albedo2", "ref") for color in "RGB"), "mask.A"]


def write_exr(path, side=64, **values):
    """Writes a square, uncompressed image with the channels of the layout demc-exr.

    The samples of a channel vary around 0.5. A keyword (`R`, `normal`, `ref`) replaces those of one channel or buffer
    by a constant, or by a function of x and y.
    """
    def attribute(name, kind, data):
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    names = sorted(CHANNELS)
    channels = b"".join(name.encode() + b"\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1) for name in names)
    window = struct.pack("<iiii", 0, 0, side - 1, side - 1)
    header = b"".join((
        struct.pack("<ii", 20000630, 2),
        attribute("channels", "chlist", channels + b"\0"),
        attribute("compression", "compression", b"\0"),
        attribute("dataWindow", "box2i", window),
        attribute("displayWindow", "box2i", window),
        attribute("lineOrder", "lineOrder", b"\0"),
        attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
        attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0, 0)),
        attribute("screenWindowWidth", "float", struct.pack("<f", 1)),
        b"\0"))
    size = 8 + 4 * side * len(names)
    first = len(header) + 8 * side
    offsets = b"".join(struct.pack("<Q", first + y * size) for y in range(side))
    lines = []
    for y in range(side):
        line = []
        for number, name in enumerate(names):
            value = values.get(name, values.get(name.split(".")[0]))
            line += ([value(x, y) for x in range(side)] if callable(value) else
                     [value] * side if value is not None else
                     [0.3 + ((x * 7 + y * 13 + number * 29) % 41) / 100 for x in range(side)])
        lines.append(struct.pack("<ii", y, size - 8) + struct.pack(f"<{len(line)}f", *line))
    path.write_bytes(header + offsets + b"".join(lines))


def write_manifest(folder, *scenes):
    """Writes `manifest.json` for scenes `(name, split, base, file)` of 64x64 pixels."""
    entries = [dict(name=name, split=split, base=base, file=file, width=64, height=64)
               for name, split, base, file in scenes]
    (folder / "manifest.json").write_text(json.dumps({"format": "demc-exr 1", "scenes": entries}))


class Attack(unittest.TestCase):
    """A test in `self.root`, a fresh copy of the template. Test names start with the item: `test_07_halo`."""

    def setUp(self):
        self._temporary = tempfile.TemporaryDirectory(prefix="demc-attack-")
        self.addCleanup(self._temporary.cleanup)
        self.root = pathlib.Path(self._temporary.name) / "project"
        shutil.copytree(template(), self.root, symlinks=True)

    def run_program(self, *command, **options):
        """Runs a program in `self.root`, counts the case, and refuses panics, aborts, and signals."""
        item = self._testMethodName.split("_")[1]
        COUNTS[item] = COUNTS.get(item, 0) + 1
        result = run(*command, cwd=self.root, **options)
        self.assertNotIn("panicked", result.stderr, result)
        self.assertIn(result.code, (0, 1, 2), result)
        return result

    def assert_refused(self, result, *words, code=1):
        """The program ended with `code`, and its standard error contains the words."""
        self.assertEqual(result.code, code, result)
        for word in words:
            self.assertIn(word, result.stderr, result)
