"""Checks arrays and shows them to the native module as [channels, height, width], without copies."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

CHANNELS = 3
"""Channels of all images except alpha and planes of layers."""
KINDS = (np.dtype(np.float16), np.dtype(np.float32))
"""Types of samples, in the machine's byte order."""


class Image(NamedTuple):
    """An array, and a view of it."""

    array: np.ndarray  # as given
    planes: np.ndarray  # [channels, height, width]


def image(name: str, value: Any) -> Image:
    """An image of three channels: (height, width, 3) or (3, height, width).

    If both fit, the last axis has the channels. Raises TypeError for another type of samples and
    ValueError for another shape.
    """
    array = samples(name, value)
    if array.ndim == 3 and array.shape[2] == CHANNELS:
        return Image(array, array.transpose(2, 0, 1))
    if array.ndim == 3 and array.shape[0] == CHANNELS:
        return Image(array, array)
    raise ValueError(f"{name} has the shape {array.shape}: expected (height, width, 3) or (3, height, width)")


def plane(name: str, value: Any) -> Image:
    """An image of one channel: (height, width).

    Raises TypeError for another type of samples and ValueError for another shape.
    """
    array = samples(name, value)
    if array.ndim != 2:
        raise ValueError(f"{name} has the shape {array.shape}: expected (height, width)")
    return Image(array, array[None])


def layer(name: str, value: Any) -> Image:
    """A layer: (height, width), (height, width, 3), or (3, height, width).

    Raises TypeError for another type of samples and ValueError for another shape.
    """
    array = samples(name, value)
    if array.ndim == 2:
        return plane(name, array)
    if array.ndim == 3 and CHANNELS in (array.shape[0], array.shape[2]):
        return image(name, array)
    raise ValueError(
        f"{name} has the shape {array.shape}: expected (height, width), (height, width, 3), or (3, height, width)"
    )


def samples(name: str, value: Any) -> np.ndarray:
    """`value` as an array. Raises TypeError unless it is float16 or float32 in the machine's byte order."""
    array = np.asarray(value)
    kind = array.dtype
    if kind in KINDS and kind.isnative:
        return array
    if name == "color" and kind.kind == "u":
        largest = np.iinfo(kind).max
        raise TypeError(
            f"color is {kind}: give linear radiance as float32, for example "
            f'((image / {largest}) ** 2.2).astype("float32")'
        )
    if not kind.isnative and kind.newbyteorder("=") in KINDS:
        raise TypeError(f'{name} has another byte order than this machine: convert it with .astype("{kind.name}")')
    if kind.kind in "fiu":
        raise TypeError(f'{name} is {kind}: expected float32 or float16; convert it with .astype("float32")')
    raise TypeError(f"{name} is {kind}: expected float32 or float16")


def empty_like(given: Image) -> Image:
    """A new array with the shape, the type, and the order of the axes of `given`."""
    return like(given, np.empty_like(given.array, subok=False))


def like(given: Image, array: np.ndarray) -> Image:
    """`array`, which has the shape of `given`, with the view that `given` has."""
    if given.array.ndim == 2:
        return Image(array, array[None])
    is_last = given.planes is not given.array
    return Image(array, array.transpose(2, 0, 1) if is_last else array)


def output(name: str, value: Any, given: Image) -> Image:
    """An array that takes the result for `given`. Raises TypeError and ValueError if it cannot."""
    if not isinstance(value, np.ndarray):
        raise TypeError(f"{name} is {type(value).__name__}: expected a NumPy array")
    array = samples(name, value)
    if array.shape != given.array.shape:
        raise ValueError(f"{name} has the shape {array.shape}: expected {given.array.shape}, the shape of color")
    if not array.flags.writeable:
        raise ValueError(f"{name} is read-only")
    return like(given, array)
