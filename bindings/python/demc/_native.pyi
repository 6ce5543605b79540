"""The native half of the package. Use the functions of `demc` instead, which check their arguments."""

from collections.abc import Callable, Sequence
from typing import Any, final

from numpy import ndarray

__version__: str

class DemcError(ValueError):
    """An image, a model, a data set, or a configuration that cannot be used. The text is one sentence."""

@final
class Bundle:
    """A network ready to denoise on the CPU. All images are [channels, height, width]."""

    def __init__(self, path: str) -> None:
        """Loads a bundled model (`quality` or `fast`), a run directory, a checkpoint directory, or a file."""

    def metadata(self) -> str:
        """Everything about the network except its weights, as JSON."""

    def required(self) -> list[str]:
        """The feature arrays that the network needs."""

    def takes_layers(self) -> bool:
        """Whether the network can denoise layers."""

    def input_scale(self, color: ndarray) -> float:
        """The factor on a colour [3, height, width] before the network."""

    def denoise(
        self,
        images: tuple[ndarray, Sequence[ndarray | None], ndarray | None, list[tuple[str, ndarray]]],
        outputs: tuple[ndarray, ndarray | None, list[ndarray]],
        options: tuple[str, float | None, bool | None, int | None],
        on_progress: Callable[[float], object] | None,
    ) -> list[str]:
        """Denoises an image into the arrays of `outputs`: colour, alpha, layers.

        `images` are colour, features, alpha, and layers with their names. `options` are the number of
        passes, the factor on the colour, whether light is restored, and MiB of memory. `on_progress`
        gets the finished share. Returns warnings.
        """

def evaluate(
    bundle: Bundle,
    data: str,
    split: str,
    layout: str | None,
    passes: str,
    on_scene: Callable[[str], object] | None,
) -> str:
    """Scores a split. `on_scene` gets the scores of each scene as JSON. Returns the report as JSON."""

def train(
    config: str,
    sets: list[str],
    resume: bool,
    quiet: bool,
    on_step: Callable[..., Any] | None,
) -> tuple[str, str, tuple[int, str] | None, list[str], list[str]]:
    """Trains a run.

    `sets` are edits `table.key=value`. `on_step` gets the fields of a `TakenStep`. Returns the run
    directory, the sentence on the kept weights, their step and scores, warnings, and notes.
    """

def infer(arguments: list[str]) -> int:
    """Runs `demc-infer` with its name and arguments. Returns the exit code."""

def run_infer(arguments: list[str]) -> None:
    """Runs a command of `demc-infer` with name and arguments. Its error becomes an exception."""

def data(arguments: list[str]) -> int:
    """Runs `demc-data` with its name and arguments. Returns the exit code."""

def train_program(arguments: list[str]) -> int:
    """Runs `demc-train` with its name and arguments. Returns the exit code."""

def presets() -> list[tuple[str, str]]:
    """The layouts of renderers' files: pairs of name and TOML text."""
