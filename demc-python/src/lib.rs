//! The Python package of the DEMC denoiser.
