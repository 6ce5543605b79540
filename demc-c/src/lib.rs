//! The C library of the DEMC denoiser.
