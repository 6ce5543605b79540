//! What training minimises: the distance of a network's output from the reference, and the way from gamma to HDR space.

use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::metrics::{SSIM_WINDOW, gaussian};
use crate::ops::{self, Ops};

/// What keeps SMAPE finite where both images are black (the value of KPCN and its successors).
const SMAPE_EPSILON: f32 = 0.01;

/// Which distance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Loss {
    /// Squared error relative to the reference, in linear HDR (Eq. 5): the paper's.
    #[default]
    RelMse,
    /// Symmetric relative absolute error in linear HDR, `mean |c - r| / (|c| + |r| + 0.01)`: bright outliers weigh less.
    Smape,
    /// Mean absolute error in gamma space, where the network works.
    L1,
}

impl Loss {
    /// All of them.
    pub const ALL: [Loss; 3] = [Loss::RelMse, Loss::Smape, Loss::L1];

    /// The loss of each image of a batch. `epsilon` is that of Eq. 5. The reference has no gradient where the kernels run.
    ///
    /// # Shapes
    /// `out_gamma` in gamma space, not negative, and `ref_hdr` in linear HDR, `[B, 3, H, W]`, to `[B]`.
    pub fn per_image(
        self,
        ops: Ops,
        out_gamma: Tensor<4>,
        ref_hdr: Tensor<4>,
        gamma: f32,
        epsilon: f32,
    ) -> Tensor<1> {
        match self {
            Loss::RelMse => ops::rel_mse_of_gamma(ops, out_gamma, ref_hdr, gamma, epsilon),
            Loss::Smape => smape(hdr_from_gamma(out_gamma, gamma), ref_hdr),
            Loss::L1 => l1(out_gamma, gamma_from_hdr(ref_hdr, gamma)),
        }
    }
}

/// Linear HDR of a network's output: `y^gamma`, the inverse of Eq. 4 for values that are not negative.
///
/// # Shapes
/// Any to the same.
pub fn hdr_from_gamma(image_gamma: Tensor<4>, gamma: f32) -> Tensor<4> {
    image_gamma.powf_scalar(gamma)
}

/// Eq. 4: `max(x, 0)^(1 / gamma)`.
///
/// # Shapes
/// Any to the same.
pub fn gamma_from_hdr(image_hdr: Tensor<4>, gamma: f32) -> Tensor<4> {
    image_hdr.clamp_min(0.0).powf_scalar(1.0 / gamma)
}

/// Eq. 5 of each image: `1/N sum (ref - out)^2 / (ref^2 + epsilon)`, N its number of pixels.
///
/// # Shapes
/// Two `[B, 3, H, W]` in linear HDR to `[B]`.
pub fn rel_mse(out_hdr: Tensor<4>, ref_hdr: Tensor<4>, epsilon: f32) -> Tensor<1> {
    let [_, channels, ..] = out_hdr.dims();
    let difference = out_hdr - ref_hdr.clone();
    let relative = difference.square() / ref_hdr.square().add_scalar(epsilon);
    mean_of_each(relative).mul_scalar(channels as f32)
}

fn smape(out_hdr: Tensor<4>, ref_hdr: Tensor<4>) -> Tensor<1> {
    let sizes = out_hdr.clone().abs() + ref_hdr.clone().abs();
    mean_of_each((out_hdr - ref_hdr).abs() / sizes.add_scalar(SMAPE_EPSILON))
}

fn l1(out_gamma: Tensor<4>, ref_gamma: Tensor<4>) -> Tensor<1> {
    mean_of_each((out_gamma - ref_gamma).abs())
}

/// `(1 - SSIM) / 2` of each image, SSIM as the metric [`ssim`](crate::metrics) has it (Wang et al. 2004), in gamma space up to 1: 0 for equal images, at
/// most 1.
///
/// # Shapes
/// Two `[B, 3, H, W]` in gamma space, sides of at least 11, to `[B]`.
pub fn dissimilarity(out_gamma: Tensor<4>, ref_gamma: Tensor<4>) -> Tensor<1> {
    const STABLE_MEAN: f32 = 0.01 * 0.01;
    const STABLE_VARIANCE: f32 = 0.03 * 0.03;
    let [_, _, height, width] = out_gamma.dims();
    let device = out_gamma.device();
    let down = windows(height, &device).swap_dims(2, 3);
    let across = windows(width, &device);
    let of_windows = |image: Tensor<4>| down.clone().matmul(image.matmul(across.clone()));
    let (a, b) = (out_gamma.clamp_max(1.0), ref_gamma.clamp_max(1.0));
    let (mean_a, mean_b) = (of_windows(a.clone()), of_windows(b.clone()));
    let means = mean_a.clone() * mean_b.clone();
    let squares = mean_a.square() + mean_b.square();
    let covariance = of_windows(a.clone() * b.clone()) - means.clone();
    let variances = of_windows(a.square() + b.square()) - squares.clone();
    let structure = covariance.mul_scalar(2.0).add_scalar(STABLE_VARIANCE)
        / variances.add_scalar(STABLE_VARIANCE);
    let level = means.mul_scalar(2.0).add_scalar(STABLE_MEAN) / squares.add_scalar(STABLE_MEAN);
    mean_of_each(structure * level)
        .neg()
        .add_scalar(1.0)
        .div_scalar(2.0)
}

/// What a row of `size` pixels is multiplied by for the mean over SSIM's window at each place inside: a band of weights. A product of matrices, which
/// every device is fast at, and has the gradient of.
///
/// # Shapes
/// `[1, 1, size, size - 10]`
fn windows(size: usize, device: &Device) -> Tensor<4> {
    let places = size + 1 - SSIM_WINDOW;
    let mut band = vec![0.0; size * places];
    for (k, tap) in gaussian().into_iter().enumerate() {
        for place in 0..places {
            band[(place + k) * places + place] = tap as f32;
        }
    }
    Tensor::from_data(TensorData::new(band, [1, 1, size, places]), device)
}

/// `[B, 3, H, W]` to the mean of each image, `[B]`.
fn mean_of_each(image: Tensor<4>) -> Tensor<1> {
    let [batch, ..] = image.dims();
    image
        .reshape([batch as isize, -1])
        .mean_dim(1)
        .reshape([-1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::{Image, LOSS_EPSILON, rel_mse_image, ssim};

    const SHAPE: [usize; 4] = [2, 3, 4, 5];

    fn pattern(phase: usize) -> Vec<f32> {
        (0..SHAPE.iter().product())
            .map(|i| ((i * 37 + phase * 11) % 101) as f32 / 101.0)
            .collect()
    }

    fn tensor(values: &[f32], device: &Device) -> Tensor<4> {
        Tensor::from_data(TensorData::new(values.to_vec(), SHAPE), device)
    }

    fn host(losses: Tensor<1>) -> Vec<f32> {
        losses.into_data().try_to_vec().unwrap()
    }

    /// Each loss of each image by a plain loop, in float64.
    fn plain(loss: Loss, out_gamma: &[f32], ref_hdr: &[f32]) -> Vec<f64> {
        let image = out_gamma.len() / SHAPE[0];
        let one = |out: &[f32], reference: &[f32]| -> f64 {
            let out_hdr: Vec<f32> = out.iter().map(|y| y.powf(2.2)).collect();
            let mean = |term: &dyn Fn(f64, f64, f64) -> f64| {
                let values = out.iter().zip(&out_hdr).zip(reference);
                let terms = values.map(|((y, c), r)| term((*y).into(), (*c).into(), (*r).into()));
                terms.sum::<f64>() / out.len() as f64
            };
            match loss {
                Loss::RelMse => rel_mse_image(&out_hdr, reference),
                Loss::Smape => mean(&|_, c, r| (c - r).abs() / (c + r + 0.01)),
                Loss::L1 => mean(&|y, _, r| (y - r.powf(1.0 / f64::from(2.2f32))).abs()),
            }
        };
        let images = out_gamma.chunks(image).zip(ref_hdr.chunks(image));
        images.map(|(out, reference)| one(out, reference)).collect()
    }

    #[test]
    fn every_loss_is_that_of_a_plain_loop_image_by_image() {
        let (out, reference) = (pattern(1), pattern(2));
        for loss in Loss::ALL {
            for ops in Ops::ALL {
                let device = Device::flex();
                let [a, b] = [&out, &reference].map(|values| tensor(values, &device));
                let found = host(loss.per_image(ops, a, b, 2.2, LOSS_EPSILON));
                let expected = plain(loss, &out, &reference);
                assert_eq!(found.len(), 2);
                for (found, expected) in found.iter().zip(expected) {
                    // float32 sums of 60 terms.
                    let near = (f64::from(*found) - expected).abs() <= 1e-5 * expected;
                    assert!(near, "{loss:?} on {ops}: {found}, not {expected}");
                }
            }
        }
    }

    /// Differences of the loss beside its gradient.
    #[test]
    fn every_gradient_is_the_slope() {
        let device = Device::flex().autodiff();
        let (out, reference) = (pattern(1), pattern(2));
        let at = |loss: Loss, out: &[f32]| {
            let [a, b] = [out, &reference[..]].map(|values| tensor(values, &device));
            let sum = loss.per_image(Ops::Kernels, a, b, 2.2, LOSS_EPSILON).sum();
            f64::from(sum.into_scalar::<f32>())
        };
        for loss in Loss::ALL {
            let a = tensor(&out, &device).require_grad();
            let b = tensor(&reference, &device);
            let sum = loss
                .per_image(Ops::Kernels, a.clone(), b, 2.2, LOSS_EPSILON)
                .sum();
            let gradient: Vec<f32> = a
                .grad(&sum.backward())
                .expect("a leaf")
                .into_data()
                .try_to_vec()
                .unwrap();
            let steepest = gradient.iter().fold(0.0f32, |most, g| most.max(g.abs()));
            for i in [0, 7, 59, 60, 119] {
                let moved = |by: f32| {
                    let mut out = out.clone();
                    out[i] += by;
                    at(loss, &out)
                };
                let slope = (moved(1e-3) - moved(-1e-3)) / 2e-3;
                let near = (slope - f64::from(gradient[i])).abs() < 0.02 * f64::from(steepest);
                assert!(near, "{loss:?}, value {i}: {}, slope {slope}", gradient[i]);
            }
        }
    }

    /// Constants have no structure: what is left is the level, `2ab / (a^2 + b^2)`, and an image that is the other upside down around
    /// its mean has the structure -1.
    #[test]
    fn dissimilarity_is_that_of_hand_computed_cases() {
        let device = Device::flex();
        let shape = [1, 3, 16, 16];
        let of = |value: &dyn Fn(usize) -> f32| {
            let values: Vec<f32> = (0..3 * 256).map(value).collect();
            Tensor::<4>::from_data(TensorData::new(values, shape), &device)
        };
        let found = |a, b| host(dissimilarity(a, b))[0];
        let flat = found(of(&|_| 0.2), of(&|_| 0.6));
        let level = (2.0 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4);
        // A variance of 0 comes out as some 1e-7, beside 9e-4.
        assert!((flat - (1.0 - level) / 2.0).abs() < 2e-4, "{flat}");
        // A checkerboard of 0.5 +- 0.3: variance 0.09.
        let board =
            |sign: f32| of(&move |i| 0.5 + sign * if (i / 16 + i) % 2 == 0 { 0.3 } else { -0.3 });
        let opposite = found(board(1.0), board(-1.0));
        let structure = (-2.0 * 0.09 + 9e-4) / (2.0 * 0.09 + 9e-4);
        assert!(
            (opposite - (1.0 - structure) / 2.0).abs() < 2e-4,
            "{opposite}"
        );
        assert!(found(board(1.0), board(1.0)).abs() < 2e-4);
        // Above 1 everything is white.
        assert!(found(of(&|_| 1.0), of(&|_| 7.0)).abs() < 2e-4);
    }

    /// Noise on a wave, with values above 1, which SSIM does not tell apart.
    #[test]
    fn dissimilarity_is_that_of_the_metric() {
        let (height, width) = (24, 37);
        let image = |phase: f32| -> Vec<f32> {
            let values = (0..3 * height * width).map(|i| {
                let noise = (i * 37 + (phase * 11.0) as usize) % 101;
                0.6 + 0.5 * (i as f32 * 0.11 + phase).sin() + 0.004 * noise as f32
            });
            values.collect()
        };
        let device = Device::flex();
        let tensor = |values: &[f32]| {
            Tensor::<4>::from_data(
                TensorData::new(values.to_vec(), [1, 3, height, width]),
                &device,
            )
        };
        let [a, b] = [0.0, 1.0].map(image);
        let found = host(dissimilarity(tensor(&a), tensor(&b)))[0];
        let hdr = |gamma: &[f32]| -> Vec<f32> { gamma.iter().map(|y| y.powf(2.2)).collect() };
        let (a, b) = (hdr(&a), hdr(&b));
        let [a, b] = [&a, &b].map(|hdr| Image::new(hdr, height, width).expect("finite"));
        let expected = (1.0 - ssim(&a, &b).expect("large enough")) / 2.0;
        assert!(expected > 0.1, "{expected}");
        assert!(
            (f64::from(found) - expected).abs() < 1e-5,
            "{found}, not {expected}"
        );
    }

    #[test]
    fn a_perfect_output_loses_nothing() {
        let device = Device::flex();
        let out = tensor(&pattern(1), &device);
        let reference = hdr_from_gamma(out.clone(), 2.2);
        for loss in Loss::ALL {
            let losses = loss.per_image(Ops::Burn, out.clone(), reference.clone(), 2.2, 1e-3);
            assert!(host(losses).iter().all(|loss| *loss < 1e-6), "{loss:?}");
        }
    }

    #[test]
    fn names_are_those_of_the_configuration() {
        for (loss, name) in Loss::ALL.into_iter().zip(["relmse", "smape", "l1"]) {
            assert_eq!(serde_json::to_value(loss).unwrap(), name);
        }
    }
}
