//! The operations of the network, implemented twice: our CPU kernels (`demc-kernels`) and Burn's
//! own.
//!
//! [`Ops`] is the implementation that a network asks for. The kernels support Burn's CPU backend
//! `flex`; every other device runs Burn's operations. Modules work on [`Maps`] and need not know
//! which one runs. Only this folder matches on [`Ops`].
//!
//! - `maps`: [`Maps`], the feature maps that the modules compute with
//! - `kernels/`: the kernels as a Burn backend extension for `flex`, with gradients
//! - `filter`: kernels per pixel with Burn's operations
//! - [`update`]: updates of the weights: Adam's step, the gradient's norm, the moving average
//! - [`muon`]: Muon's step

mod activation;
mod choice;
mod filter;
mod kernels;
mod maps;
pub mod muon;
pub mod update;

use burn::tensor::Tensor;

pub use activation::Activation;
pub use choice::{Ops, UnknownOps, process_default, set_default};
pub use demc_kernels::Isa;
pub use demc_kernels::isa::{UnknownIsa, VARIABLE as ISA_VARIABLE};
pub use demc_kernels::memory::{Recycler, return_kept, used as used_bytes};
pub use demc_kernels::{start_threads, within_pool};
pub use maps::Maps;

/// RelMSE (Eq. 5) of each image: `1/N sum (ref - out)^2 / (ref^2 + epsilon)` in linear HDR, N the
/// number of pixels.
///
/// # Shapes
/// `out_gamma` in gamma space and `ref_hdr` in linear HDR, both `[B, 3, H, W]`, to `[B]`.
pub(crate) fn rel_mse_of_gamma(
    ops: Ops,
    out_gamma: Tensor<4>,
    ref_hdr: Tensor<4>,
    gamma: f32,
    epsilon: f32,
) -> Tensor<1> {
    match ops.on(&out_gamma.device()) {
        Ops::Kernels => kernels::rel_mse_of_gamma(out_gamma, ref_hdr, gamma, epsilon),
        Ops::Burn => {
            let [_, channels, ..] = out_gamma.dims();
            let difference = out_gamma.powf_scalar(gamma) - ref_hdr.clone();
            let relative = difference.square() / ref_hdr.square().add_scalar(epsilon);
            mean_per_image(relative).mul_scalar(channels as f32)
        }
    }
}

/// The mean of each image.
///
/// # Shapes
/// `[B, C, H, W]` to `[B]`.
pub(crate) fn mean_per_image(images: Tensor<4>) -> Tensor<1> {
    let [batch, ..] = images.dims();
    images
        .reshape([batch as isize, -1])
        .mean_dim(1)
        .reshape([-1])
}
