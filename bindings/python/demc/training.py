"""`demc.evaluate` and `demc.train`."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from . import _native
from .denoising import Model, warn


class TakenStep(NamedTuple):
    """A step of `train` that was taken or skipped."""

    step: int
    """Its number, from 1."""
    steps: int
    """Number of steps of the run."""
    loss: float
    """Loss before the step, mean over its patches; NaN for a skipped step."""
    grad_norm: float
    """Norm of the gradient before clipping."""
    lr: float
    """Learning rate."""
    valid_relmse: float | None
    """RelMSE of the validation after this step, if there was one."""
    valid_ssim: float | None
    """SSIM of that validation."""


class TrainResult(NamedTuple):
    """A finished run."""

    run_dir: Path
    """The run directory. `Model.load(run_dir)` loads the weights that the run keeps."""
    kept: str
    """One sentence on which weights the run keeps, and why."""
    step: int | None
    """The step of these weights; None without a test split."""
    scores: dict[str, Any] | None
    """Their scores as `evaluate` returns them, with RelMSE and SSIM; None without a test split."""
    notes: list[str]
    """Notes, such as the checkpoint that the run resumed from."""


def evaluate(
    data: str | os.PathLike[str],
    *,
    model: Model | str | os.PathLike[str] = "quality",
    split: str = "test",
    layout: str | None = None,
    passes: int = 1,
    on_scene: Callable[[dict[str, Any]], object] | None = None,
) -> dict[str, Any]:
    """Denoises and scores the scenes of a data set, as `demc-infer evaluate --json` does.

    Arguments:
        data: directory with `manifest.json`.
        model: a `Model`, or what `Model.load` takes.
        split: `test` or `train`.
        layout: preset or TOML file of the files' channels; by default the one that fits.
        passes: mean of 1, 4, or 8 passes over flipped and transposed copies of each image.
        on_scene: called with the scores of each scene. An exception in it stops the work.

    Returns:
        `{"images": [...], "mean": {...}}`. Each image has the scores of `noisy`, `black`, and
        `denoised`, each of them a dict of all metrics, such as `relmse` and `ssim`. Scenes that
        failed are in the list `failed`, and cause a warning each.

    Raises:
        DemcError: a data set or a layout that cannot be used.
        OSError: a file that cannot be read.
        KeyboardInterrupt: after Ctrl-C, when the current scene is done.
    """
    if not isinstance(model, Model):
        model = Model.load(model)
    hear = None if on_scene is None else lambda text: on_scene(json.loads(text))
    report = json.loads(_native.evaluate(model._bundle, os.fspath(data), split, layout, str(passes), hear))
    for scene in report.get("failed", ()):
        warn(f"{scene['name']}: {scene['error']}")
    return report


def train(
    config: str | os.PathLike[str],
    *,
    overrides: Mapping[str, Any] | None = None,
    run_dir: str | os.PathLike[str] | None = None,
    resume: bool = False,
    quiet: bool = True,
    on_step: Callable[[TakenStep], object] | None = None,
) -> TrainResult:
    """Trains a run in this process and scores it, as `demc-train` does. Equal bits come out.

    Ctrl-C or an exception in `on_step` ends the run after the current step. A checkpoint is saved, and
    the exception is raised. `resume=True` resumes the run. A Ctrl-C while the data are read or the
    test scenes are scored takes effect afterwards.

    Arguments:
        config: TOML file of the run.
        overrides: keys with other values, such as `{"train.steps": 100}`; None removes a key.
        run_dir: run directory, instead of `run.dir` in the configuration.
        resume: resume the run in the run directory from its latest checkpoint.
        quiet: print nothing. Otherwise lines and a progress bar as `demc-train` prints them.
        on_step: called after every step, in the calling thread. It may call `denoise`.

    Raises:
        DemcError: a configuration, data, or a run directory that cannot be used.
        OSError: a file that cannot be read or written.
        KeyboardInterrupt: after Ctrl-C.

    Warns:
        DemcWarning: suspicious signs in the data.
    """
    edits = [_edit(key, value) for key, value in (overrides or {}).items()]
    if run_dir is not None:
        edits.append(_edit("run.dir", os.fspath(run_dir)))
    hear = None if on_step is None else lambda *values: on_step(TakenStep(*values))
    found = _native.train(os.fspath(config), edits, resume, quiet, hear)
    directory, kept, scores, problems, notes = found
    for text in problems:
        warn(text)
    step, report = scores or (None, "null")
    return TrainResult(Path(directory), kept, step, json.loads(report), notes)


def _edit(key: str, value: Any) -> str:
    """`key=value` in TOML. Raises TypeError for a value that TOML does not have."""
    return f"{key}={'' if value is None else _toml(value)}"


def _toml(value: Any) -> str:
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if isinstance(value, (bool, int, str)):
        # JSON writes these as TOML does.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    raise TypeError(f"{value!r} is {type(value).__name__}: expected a number, a string, a truth value, or a list of these")
