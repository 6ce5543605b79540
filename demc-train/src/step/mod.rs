//! One optimizer step: forward pass, loss, gradient, Adam or Muon, average of the weights.

pub mod ema;
pub mod gradients;
pub mod optimizer;
mod running_statistics;
pub mod trainer;
mod transfer;
