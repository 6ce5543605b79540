"""Denoises Monte Carlo renderings with DEMC (Yang et al. 2019), evaluates models, and trains them.

    import demc

    clean = demc.denoise(color, normal=normal, position=position, albedo=albedo)
    demc.denoise_exr("noisy.exr", "clean.exr")

Arrays are float32 or float16, (height, width, 3) or (3, height, width), with any strides. The
bundled models are inside the package. `demc.torch` has the same networks in PyTorch; it needs
`pip install demc[torch]`.

Names are imported at first use, so `demc.torch` works without the native module.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ._native import DemcError, __version__
    from .denoising import Denoised, DemcWarning, Model, denoise
    from .programs import denoise_exr, import_oidn
    from .training import TakenStep, TrainResult, evaluate, train

_MODULES = {
    "_native": ["DemcError", "__version__"],
    "denoising": ["Denoised", "DemcWarning", "Model", "denoise"],
    "programs": ["denoise_exr", "import_oidn"],
    "training": ["TakenStep", "TrainResult", "evaluate", "train"],
    "torch": [],
}

__all__ = [
    "DemcError",
    "DemcWarning",
    "Denoised",
    "Model",
    "TakenStep",
    "TrainResult",
    "__version__",
    "denoise",
    "denoise_exr",
    "evaluate",
    "import_oidn",
    "train",
]


def __getattr__(name: str) -> object:
    for module, names in _MODULES.items():
        if name == module or name in names:
            imported = import_module(f".{module}", __name__)
            return imported if name == module else getattr(imported, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "torch"})
