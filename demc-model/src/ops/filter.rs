//! Kernels per pixel and the blend of two scales, with Burn's tensor operations. Images are
//! `[B, C, H, W]`; `demc_kernels` has the definitions.

use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;
use burn::tensor::{Tensor, activation};

/// Channels of an image.
const COLORS: usize = 3;

/// See [`demc_kernels::blend::halve`].
pub(super) fn halve(x: Tensor<4>) -> Tensor<4> {
    avg_pool2d(x, AvgPoolOptions::new([2, 2]))
}

/// See [`demc_kernels::filter::forward`]. Several images may share the kernels of one.
pub(super) fn filter(x: Tensor<4>, logits: Tensor<4>) -> Tensor<4> {
    let [batch, ..] = x.dims();
    let [_, channels, height, width] = logits.dims();
    let side = channels.isqrt();
    let taps = side * side;
    let kernels = activation::softmax(logits.clone().narrow(1, 0, taps), 1);
    let padded = replicated(replicated(x.detach(), 2, side / 2), 3, side / 2);
    let tap = |tap: usize| {
        let image = padded.clone().narrow(2, tap / side, height);
        image.narrow(3, tap % side, width) * kernels.clone().narrow(1, tap, 1)
    };
    let filtered = (1..taps).fold(tap(0), |sum, i| sum + tap(i));
    if channels > taps {
        let weight = activation::sigmoid(logits.narrow(1, taps, 1));
        Tensor::cat(vec![filtered, weight.expand([batch, 1, height, width])], 1)
    } else {
        filtered
    }
}

/// See [`demc_kernels::blend::forward`].
pub(super) fn blend(filtered: Tensor<4>, coarse: Tensor<4>) -> Tensor<4> {
    let image = filtered.clone().narrow(1, 0, COLORS);
    let weight = filtered.narrow(1, COLORS, 1);
    let correction = coarse - halve(image.clone());
    image + weight * doubled(doubled(correction, 2), 3)
}

/// The image with its first and last row or column `count` more times.
fn replicated(x: Tensor<4>, axis: usize, count: usize) -> Tensor<4> {
    let last = x.dims()[axis] - 1;
    let [first, end] = [0, last].map(|index| {
        let border = x.clone().narrow(axis, index, 1);
        border.repeat_dim(axis, count)
    });
    Tensor::cat(vec![first, x, end], axis)
}

/// Twice the length along an axis, bilinear with half-pixel centres.
fn doubled(x: Tensor<4>, axis: usize) -> Tensor<4> {
    let mut shape = x.dims();
    let length = shape[axis];
    let [first, end] = [0, length - 1].map(|index| x.clone().narrow(axis, index, 1));
    let (before, after) = match length {
        1 => (x.clone(), x.clone()),
        _ => (
            Tensor::cat(vec![first, x.clone().narrow(axis, 0, length - 1)], axis),
            Tensor::cat(vec![x.clone().narrow(axis, 1, length - 1), end], axis),
        ),
    };
    let near = x.mul_scalar(0.75);
    let even = near.clone() + before.mul_scalar(0.25);
    let odd = near + after.mul_scalar(0.25);
    shape[axis] = 2 * length;
    Tensor::stack::<5>(vec![even, odd], axis + 1).reshape(shape)
}
