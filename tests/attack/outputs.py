"""Every output of every program: the file, the command that writes it, and what the command reads.

A path is relative to the project of an attack. Programs may also get it as bytes.
"""
import os
import pathlib
import shutil

from common import SAMPLE

LAYOUT = SAMPLE.parents[1] / "configs" / "renderers" / "demc-exr.toml"
MODEL = ["model.safetensors"]
RUN = ["run/config.toml", "run/metrics.jsonl", "run/latest", "run/checkpoints/step-00000002/model.safetensors"]


def cut(path, ending):
    """`path` without its ending, which the program adds."""
    return path[:-len(ending)]


def joined(path, ending):
    return path + (os.fsencode(ending) if isinstance(path, bytes) else ending)


class Output:
    """An output of a program.

    file: where the command writes it. ending: what the program adds to the path that it gets. fixed: the program
    chooses the file's name. overwrite: an existing file needs --overwrite. directory: the program creates its
    directory. suffix: how the name must end. command: from the path without ending to arguments.
    """

    def __init__(self, name, file, command, inputs, ending="", fixed=False, overwrite=False, directory=False, suffix=None):
        self.name, self.file, self.command, self.inputs = name, file, command, inputs
        self.suffix = suffix or ending
        self.ending, self.fixed, self.overwrite, self.directory = ending, fixed, overwrite, directory

    def arguments(self, path=None):
        """The command that writes `path`, which has the ending and, if that is fixed, the name of `self.file`."""
        path = self.file if path is None else path
        return self.command(os.path.dirname(path) if self.fixed else cut(path, self.ending) if self.ending else path)


def outputs(project):
    """All outputs in a prepared project."""
    scenes = ["data/manifest.json", *sorted(str(p.relative_to(project)) for p in project.glob("data/*/*.exr"))]
    baseline = str(next(project.glob("baseline/*.exr")).relative_to(project))
    scored = scenes + MODEL + ["layout.toml", baseline]
    scoring = ["--data", "data", "--model", "model.safetensors", "--layout", "layout.toml", "--baseline", "b=baseline"]
    denoise = ["demc-infer", "denoise", "frame.exr", "--model", "model.safetensors", "--layout", "layout.toml"]
    tiny = ["--config", "tiny.toml"]
    trained = scenes + ["tiny.toml"]
    return [
        Output("denoise", "out.exr", lambda o: [*denoise, "-o", o], ["frame.exr", "layout.toml", *MODEL],
               overwrite=True, directory=True, suffix=".exr"),
        Output("denoise --png", "out.png", lambda o: [*denoise, "--png", "-o", joined(o, ".exr")],
               ["frame.exr", "layout.toml", *MODEL], ending=".png", overwrite=True,
               directory=True),
        Output("denoise, run", "out.exr", lambda o: ["demc-infer", "denoise", "frame.exr", "--model", "run", "-o", o],
               RUN, overwrite=True, directory=True, suffix=".exr"),
        Output("evaluate", "scores.json", lambda o: ["demc-infer", "evaluate", *scoring, "--json", o], scored,
               overwrite=True),
        Output("report", "report.html", lambda o: ["demc-infer", "report", *scoring, "-o", o], scored, overwrite=True),
        Output("report, run", "report.html", lambda o: ["demc-infer", "report", "--data", "data", "--model", "run",
                                                        "-o", o], RUN, overwrite=True),
        Output("export", "new.safetensors",
               lambda o: ["demc-infer", "export", "--model", "model.safetensors", "--layout", "layout.toml", "-o", o],
               ["layout.toml", *MODEL], overwrite=True),
        Output("export, run", "new.onnx",
               lambda o: ["demc-infer", "export", "--format", "onnx", "--model", "run", "-o", o], RUN,
               overwrite=True),
        Output("import", "back.safetensors",
               lambda o: ["demc-infer", "import", "tuned.safetensors", "--like", "run", "-o", o],
               ["tuned.safetensors", *RUN], overwrite=True),
        Output("merge", "merged.exr", lambda o: ["demc-data", "merge", "x=frame.exr", "bare/scene.exr", "-o", o],
               ["frame.exr", "bare/scene.exr"], overwrite=True),
        Output("index", "bare/manifest.json",
               lambda o: ["demc-data", "index", o or ".", "--layout", "bare/layout.toml"],
               ["bare/scene.exr", "bare/layout.toml"], fixed=True, overwrite=True),
        Output("find-lr, csv", "sweep.csv", lambda o: ["demc-train", "find-lr", *tiny, "--steps", "10", "-o", o],
               trained, ending=".csv", directory=True, overwrite=True),
        Output("find-lr, svg", "sweep.svg", lambda o: ["demc-train", "find-lr", *tiny, "--steps", "10", "-o", o],
               trained, ending=".svg", directory=True, overwrite=True),
        Output("plot", "curves.svg", lambda o: ["demc-train", "plot", "run", "-o", o], RUN, ending=".svg",
               overwrite=True),
        *(Output(f"ablate, {name}", f"ablation/{name}",
                 lambda o: ["demc-train", "ablate", "--config", "ablation.toml", "--run-dir", o or "."],
                 [*trained, "ablation.toml"], fixed=True, directory=True)
          for name in ("ablation.md", "ablation.json", "ablation.svg", "results.csv")),
        Output("train", "fresh/test.json",
               lambda o: ["demc-train", *tiny, "--run-dir", o or ".", "--set", "train.init=model.safetensors"],
               [*trained, *MODEL], fixed=True, directory=True),
        Output("train, best", "fresh/best.safetensors",
               lambda o: ["demc-train", *tiny, "--run-dir", o or ".", "--set", "train.init=model.safetensors"],
               MODEL, fixed=True, directory=True),
    ]


def prepare(project):
    """Adds what the commands read to a project of an attack."""
    shutil.copy(LAYOUT, project / "layout.toml")
    shutil.copy(project / "model.safetensors", project / "tuned.safetensors")
    test = next(project.glob("data/test/*.exr"))
    for folder in ("baseline", "bare"):
        (project / folder).mkdir()
    shutil.copy(test, project / "baseline" / test.name)
    shutil.copy(test, project / "bare" / "scene.exr")
    shutil.copy(LAYOUT, project / "bare" / "layout.toml")
    project.joinpath("ablation.toml").write_text(
        'base = "tiny.toml"\ndir = "ablation"\nmatch_parameters = false\n'
        '[[variants]]\nname = "a"\n[[variants]]\nname = "b"\nset = ["model.variant=semc"]\n')


def contents(project):
    """The bytes of every file, but not the lock of a run."""
    files = (p for p in pathlib.Path(project).rglob("*") if p.is_file() and p.name != "lock")
    return {p: p.read_bytes() for p in files}
