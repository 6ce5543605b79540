"""The DEMC Monte Carlo denoiser (Yang et al. 2019) in PyTorch, and a reader of renderers' EXR files.

It loads and runs the weights that `demc-infer export` writes. Names are imported at first use:
`read_exr`, `Frame`, `preprocess`, and `light` need NumPy and OpenEXR only, the others PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .bundle import Bundle, load
    from .config import ModelConfig
    from .exr import Frame, read_exr
    from .metrics import gamma_from_hdr, hdr_from_gamma, rel_mse
    from .kpcn import Kpcn
    from .network import Denoiser
    from .unet import Unet

_MODULES = {
    "bundle": ["Bundle", "load"],
    "config": ["ModelConfig"],
    "exr": ["Frame", "read_exr"],
    "kpcn": ["Kpcn"],
    "layers": [],
    "layouts": [],
    "light": [],
    "metrics": ["gamma_from_hdr", "hdr_from_gamma", "rel_mse"],
    "network": ["Denoiser"],
    "preprocess": [],
    "transfer": [],
    "unet": ["Unet"],
}

__all__ = [
    "Bundle",
    "Denoiser",
    "Frame",
    "Kpcn",
    "ModelConfig",
    "Unet",
    "gamma_from_hdr",
    "hdr_from_gamma",
    "load",
    "read_exr",
    "rel_mse",
]


def __getattr__(name: str) -> object:
    for module, names in _MODULES.items():
        if name == module or name in names:
            imported = import_module(f".{module}", __name__)
            return imported if name == module else getattr(imported, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
