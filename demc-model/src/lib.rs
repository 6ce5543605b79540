//! The networks of *DEMC: A Deep Dual-Encoder Network for Denoising Monte Carlo Rendering* as Burn
//! modules.
//!
//! A [`ModelConfig`] selects a [`Variant`], a [`Reading`] and a base width. [`ModelConfig::init`]
//! returns a new [`Denoiser`], [`ModelConfig::load`] one with trained weights, and
//! [`ModelConfig::weight_specs`] describes every weight.
//!
//! The forward pass follows Fig. 3 of the paper. [`fusion`] reduces twelve feature channels to a
//! detail map. Each [`encoder`] halves its input five times. The [`decoder`] doubles the latent
//! five times and fuses the encoders' skips at each level. The layers run on one of two
//! implementations ([`ops`]): our CPU kernels or Burn's operations.
//!
//! [`kpcn`] and [`unet`] are networks of others: one to compare with, one to start from. A [`side_encoder`]
//! may stand beside the latter.
//!
//! Tensors are NCHW and float32; height and width are multiples of [`DOWNSAMPLING`]. `demc-data`
//! provides files, statistics and patches.

pub mod config;
mod cost;
pub mod decoder;
pub mod denoiser;
pub mod dual_encoder;
pub mod encoder;
mod forward;
pub mod fusion;
pub mod inference;
pub mod init;
pub mod kernel_head;
pub mod kpcn;
pub mod layers;
pub mod loss;
pub mod metrics;
pub mod ops;
pub mod pu;
pub mod side_encoder;
pub mod unet;
mod unet_size;
pub mod weights;

pub use config::{DOWNSAMPLING, Detail, Head, ModelConfig, Reading, Variant};
pub use denoiser::Denoiser;
pub use loss::LossConfig;
pub use ops::Ops;
pub use weights::{Role, Stage, Weight, WeightSpec, Weights, WeightsError};
