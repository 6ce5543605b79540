"""The PyTorch twin of the DEMC Monte Carlo denoiser (Yang et al. 2019): loads and runs what `demc-infer` exports."""

from .bundle import Bundle, load
from .metrics import gamma_from_hdr, hdr_from_gamma, rel_mse
from .network import Denoiser, ModelConfig

__all__ = ["Bundle", "Denoiser", "ModelConfig", "gamma_from_hdr", "hdr_from_gamma", "load", "rel_mse"]
