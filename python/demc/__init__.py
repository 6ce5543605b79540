"""The DEMC Monte Carlo denoiser (Yang et al. 2019) in PyTorch.

It loads and runs the weights that `demc-infer export` writes.
"""

from .bundle import Bundle, load
from .metrics import gamma_from_hdr, hdr_from_gamma, rel_mse
from .network import Denoiser, ModelConfig

__all__ = ["Bundle", "Denoiser", "ModelConfig", "gamma_from_hdr", "hdr_from_gamma", "load", "rel_mse"]
