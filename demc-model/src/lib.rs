//! The networks of *DEMC: A Deep Dual-Encoder Network for Denoising Monte Carlo Rendering* as Burn modules.
//!
//! A [`ModelConfig`] names a [`Variant`], a [`Reading`] and a base width; [`ModelConfig::init`] draws the weights of a
//! new [`Denoiser`], [`ModelConfig::load`] takes those of a trained one. The forward pass reads like Fig. 3 of the paper:
//! [`fusion`] squeezes twelve feature channels into a detail map, each [`encoder`] halves its input five times, and
//! the [`decoder`] climbs back from the latent, fusing the encoders' skips on its way.
//!
//! What the layers compute is one of two implementations of the same operations ([`ops`]): our CPU kernels or Burn's own.
//!
//! Tensors are NCHW, float32; height and width are multiples of [`DOWNSAMPLING`]. Files, statistics and patches are
//! not known here: see `demc-data`.

pub mod config;
mod cost;
pub mod decoder;
pub mod denoiser;
pub mod dormant;
pub mod encoder;
pub mod fusion;
pub mod inference;
pub mod init;
pub mod layers;
pub mod loss;
pub mod metrics;
pub mod ops;
pub mod weights;

pub use config::{DOWNSAMPLING, Detail, Head, ModelConfig, Reading, Variant};
pub use denoiser::Denoiser;
pub use loss::Loss;
pub use ops::Ops;
pub use weights::{Weight, Weights, WeightsError};
