"""The command-line programs `demc-infer`, `demc-data`, and `demc-train`; `demc.denoise_exr` and `demc.import_oidn`."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence

from . import _native
from .denoising import Model


def denoise_exr(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] = "quality",
    layout: str | os.PathLike[str] | None = None,
    layers: Sequence[str] = (),
    repair: bool = False,
    overwrite: bool = False,
) -> None:
    """Denoises an OpenEXR file, as `demc-infer denoise` does.

    The result is the source with other colour: parts, windows, attributes, and other channels stay.
    Channels may have the names that Mitsuba, pbrt, Blender Cycles, LuxCore, or FBKSD write. Warnings
    and notes appear on standard error.

    Arguments:
        source: noisy image with feature channels.
        target: file to write.
        model: `quality`, `fast`, a run directory, a checkpoint, or an exported file.
        layout: preset or TOML file of the channels; by default the one that fits.
        layers: names or glob patterns of further channels to denoise; not with a KPCN model.
        repair: whether NaN, infinite, and negative samples are replaced by the median around them.
        overwrite: whether an existing target is replaced. One that was made with these options stays as it is.

    Raises:
        DemcError: an image or a model that cannot be used; an existing target of other options or another program.
        OSError: a file that cannot be read or written.
        KeyboardInterrupt: after Ctrl-C, when the image is done.
    """
    arguments: list[str | os.PathLike[str]] = ["demc-infer", "denoise", "--model", model]
    if layout is not None:
        arguments += ["--layout", layout]
    for pattern in layers:
        arguments += ["--layers", pattern]
    arguments += [flag for flag, wanted in (("--repair", repair), ("--overwrite", overwrite)) if wanted]
    _native.run_infer([os.fspath(argument) for argument in [*arguments, "--output", target, "--", source]])


def import_oidn(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    weights: str | None = None,
    overwrite: bool = False,
) -> Model:
    """Makes a model file of weights of Open Image Denoise, and loads it.

    Arguments:
        source: the library `libOpenImageDenoise_core`, such as that of the package `pyoidn`, or a TZA file.
        target: model file to write.
        weights: their name in the library; by default `rt_hdr_alb_nrm`.
        overwrite: whether an existing target is replaced.

    Raises:
        DemcError: a file without such weights, or a damaged one; an unknown name; an existing target.
        OSError: a file that cannot be read or written.
    """
    arguments = ["demc-infer", "import", "--oidn", os.fspath(source), "--output", os.fspath(target)]
    if weights is not None:
        arguments += ["--weights", weights]
    if overwrite:
        arguments.append("--overwrite")
    _native.run_infer(arguments)
    return Model(target)


def infer() -> None:
    """Runs `demc-infer` with the arguments of this process, and exits."""
    _run(_native.infer)


def data() -> None:
    """Runs `demc-data` with the arguments of this process, and exits."""
    _run(_native.data)


def train() -> None:
    """Runs `demc-train` with the arguments of this process, and exits."""
    _run(_native.train_program)


def _run(program: Callable[[list[str]], int]) -> None:
    # Python's handler would wait for the end of the program.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(program(sys.argv))
