"""`demc.denoise` and `demc.Model`."""

from __future__ import annotations

import json
import os
import sys
import threading
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from . import arrays
from ._native import Bundle

COLORS = "RGB"
"""The ends of the names of a layer's three channels."""
_LOCK = threading.Lock()
_BUNDLED: dict[str, Model] = {}


class DemcWarning(UserWarning):
    """An image that differs from the training scenes, or a result that is suspicious."""


class Denoised(NamedTuple):
    """The result of `denoise` for an image with alpha or layers. All arrays are like those given."""

    color: np.ndarray
    """Linear radiance, not negative."""
    alpha: np.ndarray | None
    """Alpha (height, width); None if none was given."""
    layers: dict[str, np.ndarray]
    """The layers by name, of either sign."""


class DenoiseOptions(TypedDict, total=False):
    """Arguments of `denoise` that do not change the type of its result."""

    normal: ArrayLike | None
    position: ArrayLike | None
    albedo: ArrayLike | None
    albedo2: ArrayLike | None
    out: np.ndarray | None
    passes: int
    input_scale: float | None
    restore_light: bool | None
    memory: int | None
    on_progress: Callable[[float], object] | None


class Model:
    """A network ready to denoise on the CPU. Several threads may use it at the same time."""

    def __init__(self, path: str | os.PathLike[str] = "quality") -> None:
        """Loads a run directory of `train`, a checkpoint directory, or a file of `demc-infer export`.

        `quality` and `fast` are models inside the package; `./fast` is a file. Raises OSError for a
        file that cannot be read and DemcError for one that is damaged or has another format.
        """
        self._path = os.fspath(path)
        self._bundle = Bundle(self._path)

    @classmethod
    def load(cls, path: str | os.PathLike[str] = "quality") -> Model:
        """Loads a model as `Model(path)` does. `quality` and `fast` are read only once."""
        if path not in ("quality", "fast"):
            return cls(path)
        with _LOCK:
            if path not in _BUNDLED:
                _BUNDLED[path] = cls(path)
            return _BUNDLED[path]

    @property
    def name(self) -> str:
        """The path that it was loaded from."""
        return self._path

    @property
    def metadata(self) -> dict[str, Any]:
        """Everything about the network except its weights, as in the header of an exported file."""
        return json.loads(self._bundle.metadata())

    @property
    def step(self) -> int:
        """Number of optimizer steps behind the weights."""
        return self.metadata["step"]

    @property
    def required(self) -> tuple[str, ...]:
        """The arguments of `denoise` that this network needs beside `color`."""
        return tuple(self._bundle.required())

    @property
    def takes_layers(self) -> bool:
        """Whether `denoise` accepts layers: all models but those of KPCN do."""
        return self._bundle.takes_layers()

    def input_scale(self, color: ArrayLike) -> float:
        """The factor on `color` before the network, which `denoise` uses by default.

        Give the factor of one frame to all frames of a sequence; otherwise brightness may flicker.
        Raises DemcError for NaN or infinite samples.
        """
        return self._bundle.input_scale(arrays.image("color", color).planes)

    @overload
    def denoise(
        self, color: ArrayLike, *, alpha: None = None, layers: None = None, **options: Unpack[DenoiseOptions]
    ) -> np.ndarray: ...

    @overload
    def denoise(
        self,
        color: ArrayLike,
        *,
        alpha: ArrayLike | None = None,
        layers: Mapping[str, ArrayLike] | None = None,
        **options: Unpack[DenoiseOptions],
    ) -> Denoised: ...

    def denoise(self, color: ArrayLike, **options: Any) -> np.ndarray | Denoised:
        """Denoises with this model. The arguments are those of `demc.denoise`."""
        return denoise(color, model=self, **options)

    def __repr__(self) -> str:
        return f"<demc.Model {self.name}, step {self.step}>"


@overload
def denoise(
    color: ArrayLike,
    *,
    alpha: None = None,
    layers: None = None,
    model: Model | str | os.PathLike[str] = "quality",
    **options: Unpack[DenoiseOptions],
) -> np.ndarray: ...


@overload
def denoise(
    color: ArrayLike,
    *,
    alpha: ArrayLike | None = None,
    layers: Mapping[str, ArrayLike] | None = None,
    model: Model | str | os.PathLike[str] = "quality",
    **options: Unpack[DenoiseOptions],
) -> Denoised: ...


def denoise(
    color: ArrayLike,
    *,
    normal: ArrayLike | None = None,
    position: ArrayLike | None = None,
    albedo: ArrayLike | None = None,
    albedo2: ArrayLike | None = None,
    alpha: ArrayLike | None = None,
    layers: Mapping[str, ArrayLike] | None = None,
    model: Model | str | os.PathLike[str] = "quality",
    out: np.ndarray | None = None,
    passes: int = 1,
    input_scale: float | None = None,
    restore_light: bool | None = None,
    memory: int | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> np.ndarray | Denoised:
    """Denoises an image.

    All images have the height and width of `color`. They are float32 or float16, (height, width, 3)
    or (3, height, width), each with any strides. If the first and the last axis have length 3, the
    last one has the channels. Do not change the arrays during the call: it releases the GIL.

    Arguments:
        color: noisy colour: linear radiance. Negative samples count as 0.
        normal: shading normal at the first hit: world space, not encoded.
        position: position of the first hit: world space. A pixel without a hit is 0 or infinite.
        albedo: albedo of the first hit.
        albedo2: albedo of the second hit; by default that of the first hit.
        alpha: alpha of the colour (height, width), 0 to 1, denoised with it.
        layers: further channels by name, (height, width) or three channels, that are denoised
            beside the colour. Layers that add up to it still do. A plane whose name ends in `.R`,
            `.G`, or `.B` belongs to that channel of the colour. Needs `Model.takes_layers`.
        model: a `Model`, or what `Model.load` takes.
        out: array for the result, with the shape of `color`; may be `color` itself.
        passes: mean of 1, 4, or 8 passes over flipped and transposed copies. Layers of a kernel head
            need 1.
        input_scale: factor on the colour before the network; by default `Model.input_scale(color)`.
        restore_light: whether the result gets the light of the noisy image; by default as the model
            says.
        memory: MiB for a pass; by default the available memory. Larger images are cut into tiles,
            with the same result.
        on_progress: called with the finished share of the image, 0 to 1. An exception in it stops
            the work and is raised again.

    Returns:
        The denoised image, like `color` in shape, type, and order of axes. With `alpha` or `layers`,
        a `Denoised`: colour, alpha, and layers.

    Raises:
        TypeError: samples of another type. The text says how to convert them.
        ValueError: an array of another shape, or one that cannot be written to.
        DemcError: an image with NaN or infinite samples, without pixels, of another size than
            `color`, or unlike all training scenes; an array that the model needs and that is absent.
        OSError: a model that cannot be read.
        KeyboardInterrupt: after Ctrl-C.

    Warns:
        DemcWarning: an image that differs from the training scenes, with the likely cause.
    """
    if not isinstance(model, Model):
        model = Model.load(model)
    features = (normal, position, albedo, albedo2)
    names = ("normal", "position", "albedo", "albedo2")
    given = arrays.image("color", color)
    views = [None if value is None else arrays.image(name, value).planes for name, value in zip(names, features)]
    mask = None if alpha is None else arrays.plane("alpha", alpha)
    extra = {name: arrays.layer(f"layer {name}", value) for name, value in (layers or {}).items()}
    target = arrays.empty_like(given) if out is None else arrays.output("out", out, given)
    alpha_target = None if mask is None else arrays.empty_like(mask)
    layer_targets = {name: arrays.empty_like(layer) for name, layer in extra.items()}
    found = model._bundle.denoise(
        (given.planes, views, mask and mask.planes, _planes(extra)),
        (target.planes, alpha_target and alpha_target.planes, [plane for _, plane in _planes(layer_targets)]),
        (str(passes), input_scale, restore_light, memory),
        on_progress,
    )
    for text in found:
        warn(text)
    if mask is None and layers is None:
        return target.array
    return Denoised(
        target.array,
        None if alpha_target is None else alpha_target.array,
        {name: layer.array for name, layer in layer_targets.items()},
    )


def warn(text: str) -> None:
    """Warns at the line that called the package."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__package__") == __package__:
        level, frame = level + 1, frame.f_back
    warnings.warn(text, DemcWarning, stacklevel=level)


def _planes(images: Mapping[str, arrays.Image]) -> list[tuple[str, np.ndarray]]:
    """Views [1, height, width] of all channels by name."""
    found = []
    for name, (_, planes) in images.items():
        if len(planes) == 1:
            found.append((name, planes))
        else:
            found += [(f"{name}.{end}", planes[i : i + 1]) for i, end in enumerate(COLORS)]
    return found
