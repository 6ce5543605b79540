//! The training loss: a weighted sum of distances between output and reference.

use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::metrics::{LOSS_EPSILON, SSIM_WINDOW, gaussian};
use crate::ops::{self, Ops, mean_per_image};

/// Constant that keeps SMAPE finite where both images are black (KPCN, Vogels et al. 2018).
const SMAPE_EPSILON: f32 = 0.01;

/// The `[loss]` table: the weights of the terms. A term with weight 0 is not computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Weight of RelMSE, the squared error relative to the reference in linear HDR (Eq. 5). The
    /// paper's loss is this term alone, with weight 1.
    pub relmse: f32,
    /// Weight of [`dssim`], `(1 - SSIM) / 2` in gamma space.
    pub dssim: f32,
    /// Weight of SMAPE in linear HDR, `mean |c - r| / (|c| + |r| + 0.01)` (Vogels et al. 2018).
    pub smape: f32,
    /// Weight of the mean absolute error in gamma space, the space of the network's output.
    pub l1: f32,
    /// Weight of the mean absolute error in linear HDR (Bako et al. 2017).
    pub l1_hdr: f32,
    /// Share of the steps, at the start, in which each network of KPCN has its own loss instead. That
    /// is the mean absolute error in its space (Bako et al. 2017). 0 for other variants.
    pub separate: f32,
    /// Epsilon of RelMSE (Eq. 5).
    pub relmse_epsilon: f32,
}

impl Default for LossConfig {
    /// The paper's loss (Eq. 5).
    fn default() -> Self {
        LossConfig {
            relmse: 1.0,
            dssim: 0.0,
            smape: 0.0,
            l1: 0.0,
            l1_hdr: 0.0,
            separate: 0.0,
            relmse_epsilon: LOSS_EPSILON,
        }
    }
}

impl LossConfig {
    /// Every problem of the values, as one line each that begins with the key.
    pub fn validate(&self) -> Vec<String> {
        let weights = [
            ("relmse", self.relmse),
            ("dssim", self.dssim),
            ("smape", self.smape),
            ("l1", self.l1),
            ("l1_hdr", self.l1_hdr),
        ];
        let mut problems = Vec::new();
        for (key, weight) in weights {
            if !(weight.is_finite() && weight >= 0.0) {
                problems.push(format!(
                    "loss.{key} = {weight:?}: must be a finite weight of at least 0"
                ));
            }
        }
        if weights.iter().all(|(_, weight)| *weight == 0.0) {
            problems.push(
                "loss: at least one of relmse, dssim, smape, l1 and l1_hdr must be above 0".into(),
            );
        }
        if !(0.0..=1.0).contains(&self.separate) {
            let share = self.separate;
            problems.push(format!("loss.separate = {share:?}: must be from 0 to 1"));
        }
        let epsilon = self.relmse_epsilon;
        if !(epsilon.is_finite() && epsilon > 0.0) {
            problems.push(format!(
                "loss.relmse_epsilon = {epsilon:?}: must be a positive number"
            ));
        }
        problems
    }

    /// The loss of each image of a batch. The reference has no gradient where the kernels run.
    ///
    /// # Shapes
    /// `out_gamma` in gamma space, not negative, and `ref_hdr` in linear HDR, `[B, 3, H, W]`, to
    /// `[B]`.
    ///
    /// # Panics
    /// If all weights are 0; see [`Self::validate`].
    pub fn per_image(
        &self,
        ops: Ops,
        out_gamma: Tensor<4>,
        ref_hdr: Tensor<4>,
        gamma: f32,
    ) -> Tensor<1> {
        let term = |weight: f32, distance: &dyn Fn(Tensor<4>, Tensor<4>) -> Tensor<1>| {
            (weight > 0.0).then(|| {
                let distances = distance(out_gamma.clone(), ref_hdr.clone());
                // A product with 1 would cost a pass over the tensor's graph.
                if weight == 1.0 {
                    distances
                } else {
                    distances.mul_scalar(weight)
                }
            })
        };
        let terms = [
            term(self.relmse, &|out, reference| {
                ops::rel_mse_of_gamma(ops, out, reference, gamma, self.relmse_epsilon)
            }),
            term(self.smape, &|out, reference| {
                smape(hdr_from_gamma(out, gamma), reference)
            }),
            term(self.l1, &|out, reference| {
                l1(out, gamma_from_hdr(reference, gamma))
            }),
            term(self.l1_hdr, &|out, reference| {
                mean_per_image((hdr_from_gamma(out, gamma) - reference).abs())
            }),
            term(self.dssim, &|out, reference| {
                dssim(out, gamma_from_hdr(reference, gamma))
            }),
        ];
        let sum = terms.into_iter().flatten().reduce(|sum, term| sum + term);
        sum.expect("a loss has a term")
    }
}

/// Linear HDR of an image in gamma space: `y^gamma`, the inverse of Eq. 4 for `y >= 0`.
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

fn smape(out_hdr: Tensor<4>, ref_hdr: Tensor<4>) -> Tensor<1> {
    let sizes = out_hdr.clone().abs() + ref_hdr.clone().abs();
    mean_per_image((out_hdr - ref_hdr).abs() / sizes.add_scalar(SMAPE_EPSILON))
}

/// Mean absolute error of each image, in gamma space.
fn l1(out_gamma: Tensor<4>, ref_gamma: Tensor<4>) -> Tensor<1> {
    mean_per_image((out_gamma - ref_gamma).abs())
}

/// DSSIM of each image: `(1 - SSIM) / 2` in gamma space, clipped to 1. It is 0 for equal images and
/// at most 1. SSIM is that of [`crate::metrics::ssim`] (Wang et al. 2004).
///
/// # Shapes
/// Two `[B, 3, H, W]` in gamma space, sides of at least 11, to `[B]`.
pub fn dssim(out_gamma: Tensor<4>, ref_gamma: Tensor<4>) -> Tensor<1> {
    const STABLE_MEAN: f32 = 0.01 * 0.01;
    const STABLE_VARIANCE: f32 = 0.03 * 0.03;
    let [_, _, height, width] = out_gamma.dims();
    let device = out_gamma.device();
    let down = windows(height, &device).swap_dims(2, 3);
    let across = windows(width, &device);
    let window_mean = |image: Tensor<4>| down.clone().matmul(image.matmul(across.clone()));
    let (a, b) = (out_gamma.clamp_max(1.0), ref_gamma.clamp_max(1.0));
    let (mean_a, mean_b) = (window_mean(a.clone()), window_mean(b.clone()));
    let means = mean_a.clone() * mean_b.clone();
    let squares = mean_a.square() + mean_b.square();
    let covariance = window_mean(a.clone() * b.clone()) - means.clone();
    let variances = window_mean(a.square() + b.square()) - squares.clone();
    let structure = covariance.mul_scalar(2.0).add_scalar(STABLE_VARIANCE)
        / variances.add_scalar(STABLE_VARIANCE);
    let level = means.mul_scalar(2.0).add_scalar(STABLE_MEAN) / squares.add_scalar(STABLE_MEAN);
    mean_per_image(structure * level)
        .neg()
        .add_scalar(1.0)
        .div_scalar(2.0)
}

/// The band matrix of SSIM's window along an axis of `size` pixels. A row of pixels times this
/// matrix is the mean over the window at each position. Every device multiplies matrices fast and
/// differentiates the product.
///
/// # Shapes
/// `[1, 1, size, size - 10]`
fn windows(size: usize, device: &Device) -> Tensor<4> {
    let positions = size + 1 - SSIM_WINDOW;
    let mut band = vec![0.0; size * positions];
    for (k, tap) in gaussian().into_iter().enumerate() {
        for position in 0..positions {
            band[(position + k) * positions + position] = tap as f32;
        }
    }
    Tensor::from_data(TensorData::new(band, [1, 1, size, positions]), device)
}

#[cfg(test)]
mod tests;
