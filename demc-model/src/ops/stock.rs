//! The operations made of Burn's own, on `[B, C, H, W]`: for every device, and the kernels' peer in tests.

use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::tensor::{Tensor, activation, module::max_pool2d, ops::MaxPoolOptions};

use super::Activation;
use crate::loss::{hdr_from_gamma, rel_mse};

pub(super) fn conv(x: Tensor<4>, conv: &Conv2d, activation: Activation) -> Tensor<4> {
    activated(conv.forward(x), activation)
}

pub(super) fn deconv(x: Tensor<4>, deconv: &ConvTranspose2d, activation: Activation) -> Tensor<4> {
    activated(deconv.forward(x), activation)
}

pub(super) fn batch_norm(x: Tensor<4>, norm: &BatchNorm, activation: Activation) -> Tensor<4> {
    activated(norm.forward(x), activation)
}

pub(super) fn max_pool(x: Tensor<4>) -> Tensor<4> {
    max_pool2d(x, MaxPoolOptions::new([2, 2]))
}

pub(super) fn rel_mse_of_gamma(
    out_gamma: Tensor<4>,
    ref_hdr: Tensor<4>,
    gamma: f32,
    epsilon: f32,
) -> Tensor<1> {
    rel_mse(hdr_from_gamma(out_gamma, gamma), ref_hdr, epsilon)
}

fn activated(x: Tensor<4>, activation: Activation) -> Tensor<4> {
    match activation {
        Activation::None => x,
        Activation::Relu => activation::relu(x),
    }
}
