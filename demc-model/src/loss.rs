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
            problems
                .push("loss: at least one of relmse, dssim, smape and l1 must be above 0".into());
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
mod tests {
    use super::*;
    use crate::metrics::{Image, rel_mse_image, ssim};

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

    const TERMS: [(&str, LossConfig); 3] = {
        let none = LossConfig {
            relmse: 0.0,
            dssim: 0.0,
            smape: 0.0,
            l1: 0.0,
            relmse_epsilon: LOSS_EPSILON,
        };
        [
            (
                "relmse",
                LossConfig {
                    relmse: 1.0,
                    ..none
                },
            ),
            ("smape", LossConfig { smape: 1.0, ..none }),
            ("l1", LossConfig { l1: 1.0, ..none }),
        ]
    };

    /// One term of each image's loss, computed by a loop in float64.
    fn plain(term: &str, out_gamma: &[f32], ref_hdr: &[f32]) -> Vec<f64> {
        let image = out_gamma.len() / SHAPE[0];
        let one = |out: &[f32], reference: &[f32]| -> f64 {
            let out_hdr: Vec<f32> = out.iter().map(|y| y.powf(2.2)).collect();
            let mean = |term: &dyn Fn(f64, f64, f64) -> f64| {
                let values = out.iter().zip(&out_hdr).zip(reference);
                let terms = values.map(|((y, c), r)| term((*y).into(), (*c).into(), (*r).into()));
                terms.sum::<f64>() / out.len() as f64
            };
            match term {
                "relmse" => rel_mse_image(&out_hdr, reference),
                "smape" => mean(&|_, c, r| (c - r).abs() / (c + r + 0.01)),
                _ => mean(&|y, _, r| (y - r.powf(1.0 / f64::from(2.2f32))).abs()),
            }
        };
        let images = out_gamma.chunks(image).zip(ref_hdr.chunks(image));
        images.map(|(out, reference)| one(out, reference)).collect()
    }

    #[test]
    fn every_term_agrees_with_a_loop_for_each_image() {
        let (out, reference) = (pattern(1), pattern(2));
        for (term, loss) in TERMS {
            for ops in Ops::ALL {
                let device = Device::flex();
                let [a, b] = [&out, &reference].map(|values| tensor(values, &device));
                let found = host(loss.per_image(ops, a, b, 2.2));
                let expected = plain(term, &out, &reference);
                assert_eq!(found.len(), 2);
                for (found, expected) in found.iter().zip(expected) {
                    // float32 sums of 60 terms.
                    let near = (f64::from(*found) - expected).abs() <= 1e-5 * expected;
                    assert!(near, "{term} on {ops}: {found}, not {expected}");
                }
            }
        }
    }

    #[test]
    fn every_gradient_agrees_with_differences() {
        let device = Device::flex().autodiff();
        let (out, reference) = (pattern(1), pattern(2));
        let loss_sum = |loss: LossConfig, out: &[f32]| {
            let [a, b] = [out, &reference[..]].map(|values| tensor(values, &device));
            let sum = loss.per_image(Ops::Kernels, a, b, 2.2).sum();
            f64::from(sum.into_scalar::<f32>())
        };
        for (term, loss) in TERMS {
            let a = tensor(&out, &device).require_grad();
            let b = tensor(&reference, &device);
            let sum = loss.per_image(Ops::Kernels, a.clone(), b, 2.2).sum();
            let gradient: Vec<f32> = a
                .grad(&sum.backward())
                .expect("a leaf")
                .into_data()
                .try_to_vec()
                .unwrap();
            let steepest = gradient.iter().fold(0.0f32, |most, g| most.max(g.abs()));
            for i in [0, 7, 59, 60, 119] {
                let moved = |distance: f32| {
                    let mut out = out.clone();
                    out[i] += distance;
                    loss_sum(loss, &out)
                };
                let slope = (moved(1e-3) - moved(-1e-3)) / 2e-3;
                let near = (slope - f64::from(gradient[i])).abs() < 0.02 * f64::from(steepest);
                assert!(near, "{term}, value {i}: {}, slope {slope}", gradient[i]);
            }
        }
    }

    /// Constant images differ only in the luminance term, `2ab / (a^2 + b^2)`. An image mirrored
    /// around its mean has the structure term -1.
    #[test]
    fn dssim_agrees_with_hand_computed_cases() {
        let device = Device::flex();
        let shape = [1, 3, 16, 16];
        let image = |value: &dyn Fn(usize) -> f32| {
            let values: Vec<f32> = (0..3 * 256).map(value).collect();
            Tensor::<4>::from_data(TensorData::new(values, shape), &device)
        };
        let found = |a, b| host(dssim(a, b))[0];
        let flat = found(image(&|_| 0.2), image(&|_| 0.6));
        let level = (2.0 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4);
        // Rounding gives a variance of about 1e-7 instead of 0, beside the constant 9e-4.
        assert!((flat - (1.0 - level) / 2.0).abs() < 2e-4, "{flat}");
        // A checkerboard of 0.5 +- 0.3: variance 0.09.
        let board = |sign: f32| {
            image(&move |i| 0.5 + sign * if (i / 16 + i) % 2 == 0 { 0.3 } else { -0.3 })
        };
        let opposite = found(board(1.0), board(-1.0));
        let structure = (-2.0 * 0.09 + 9e-4) / (2.0 * 0.09 + 9e-4);
        assert!(
            (opposite - (1.0 - structure) / 2.0).abs() < 2e-4,
            "{opposite}"
        );
        assert!(found(board(1.0), board(1.0)).abs() < 2e-4);
        // Values above 1 are clipped to white.
        assert!(found(image(&|_| 1.0), image(&|_| 7.0)).abs() < 2e-4);
    }

    /// A wave with noise and values above 1, which are clipped.
    #[test]
    fn dssim_agrees_with_the_metric() {
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
        let found = host(dssim(tensor(&a), tensor(&b)))[0];
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
    fn the_loss_of_a_perfect_output_is_zero() {
        let device = Device::flex();
        let out = tensor(&pattern(1), &device);
        let reference = hdr_from_gamma(out.clone(), 2.2);
        for (term, loss) in TERMS {
            let losses = loss.per_image(Ops::Burn, out.clone(), reference.clone(), 2.2);
            assert!(host(losses).iter().all(|loss| *loss < 1e-6), "{term}");
        }
    }

    /// `2 RelMSE + 3 SMAPE + 0.5 DSSIM` of images larger than SSIM's window.
    #[test]
    fn weighted_terms_are_added() {
        let device = Device::flex();
        let shape = [1, 3, 16, 16];
        let image = |phase: usize| {
            let values: Vec<f32> = (0..768)
                .map(|i| ((i * 37 + phase) % 101) as f32 / 101.0)
                .collect();
            Tensor::<4>::from_data(TensorData::new(values, shape), &device)
        };
        let loss_of =
            |loss: LossConfig| host(loss.per_image(Ops::Burn, image(0), image(13), 2.2))[0];
        let [(_, relmse), (_, smape), (_, l1)] = TERMS;
        let mixed = LossConfig {
            relmse: 2.0,
            smape: 3.0,
            dssim: 0.5,
            ..l1
        };
        let mixed = LossConfig { l1: 0.0, ..mixed };
        let dssim = LossConfig {
            l1: 0.0,
            dssim: 1.0,
            ..l1
        };
        let expected = 2.0 * loss_of(relmse) + 3.0 * loss_of(smape) + 0.5 * loss_of(dssim);
        assert!((loss_of(mixed) - expected).abs() < 1e-5 * expected);
    }

    #[test]
    fn keys_are_those_of_the_configuration() {
        let table = serde_json::to_value(LossConfig::default()).unwrap();
        let mut keys: Vec<&String> = table.as_object().expect("a table").keys().collect();
        let mut expected = ["relmse", "dssim", "smape", "l1", "relmse_epsilon"];
        keys.sort_unstable();
        expected.sort_unstable();
        assert_eq!(keys, expected);
        let unknown: Result<LossConfig, _> = serde_json::from_str(r#"{ "ssim": 1.0 }"#);
        assert!(unknown.is_err());
    }

    #[test]
    fn problems_name_their_keys() {
        assert_eq!(LossConfig::default().validate(), Vec::<String>::new());
        let wrong = LossConfig {
            relmse: 0.0,
            smape: -1.0,
            relmse_epsilon: 0.0,
            ..LossConfig::default()
        };
        let problems = wrong.validate();
        assert_eq!(problems.len(), 2, "{problems:?}");
        assert!(problems[0].starts_with("loss.smape = -1.0: "));
        assert!(problems[1].starts_with("loss.relmse_epsilon = 0.0: "));
        let none = LossConfig {
            relmse: 0.0,
            ..LossConfig::default()
        };
        assert!(none.validate()[0].starts_with("loss: at least one of "));
    }
}
