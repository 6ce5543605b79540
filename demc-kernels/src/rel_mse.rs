//! The training loss (Eq. 5) on the network's output in gamma space, and its gradient, in one pass.
//!
//! The power is computed in float64, exact to 1e-9.

use crate::Isa;
use crate::power::power;
use crate::simd::{self, Leaf, Simd};
use crate::tasks::{self, TASK};

/// The constants of the loss.
#[derive(Clone, Copy, Debug)]
pub struct RelMse {
    /// Pixels of the batch.
    pub pixels: usize,
    /// Exponent of the output, from 1 to 6.
    pub gamma: f32,
    /// Added to the squared reference.
    pub epsilon: f32,
}

/// `1 / pixels * sum (out_gamma^gamma - ref_hdr)^2 / (ref_hdr^2 + epsilon)` over all values (Eq.
/// 5). Writes the gradient with respect to `out_gamma` to `dout`; it is 0 where `out_gamma` is 0.
///
/// Negative, NaN and infinite outputs make the loss and their gradient non-finite.
///
/// # Shapes
/// `out_gamma`, `ref_hdr` and `dout` have the same shape, in any layout.
///
/// # Panics
/// If the lengths differ, or gamma is below 1 (an infinite gradient at 0) or above 6.
pub fn loss(
    isa: Isa,
    out_gamma: &[f32],
    ref_hdr: &[f32],
    scale: RelMse,
    dout: Option<&mut [f32]>,
) -> f64 {
    let RelMse {
        pixels,
        gamma,
        epsilon,
    } = scale;
    assert_eq!(
        out_gamma.len(),
        ref_hdr.len(),
        "output and reference of one size"
    );
    assert!(
        (1.0..=6.0).contains(&gamma),
        "gamma {gamma} is not between 1 and 6"
    );
    let rule = LossTerm {
        gamma: f64::from(gamma),
        epsilon: f64::from(epsilon),
        share: 1.0 / pixels as f64,
    };
    let pieces = out_gamma.chunks(TASK).zip(ref_hdr.chunks(TASK));
    let sums = match dout {
        Some(dout) => {
            assert_eq!(
                dout.len(),
                out_gamma.len(),
                "gradient and output of one size"
            );
            tasks::map(
                pieces.zip(dout.chunks_mut(TASK)),
                |((out, reference), dout)| {
                    // SAFETY: the leaf accesses memory through slices only.
                    unsafe {
                        simd::run(
                            isa,
                            LossAndGradient {
                                rule,
                                out,
                                reference,
                                dout,
                            },
                        )
                    }
                },
            )
        }
        None => tasks::map(pieces, |(out, reference)| {
            // SAFETY: the leaf accesses memory through slices only.
            unsafe {
                simd::run(
                    isa,
                    LossOnly {
                        rule,
                        out,
                        reference,
                    },
                )
            }
        }),
    };
    sums.into_iter().sum::<f64>() * rule.share
}

/// Number of independent partial sums.
const LANES: usize = 16;

#[derive(Clone, Copy)]
struct LossTerm {
    gamma: f64,
    epsilon: f64,
    share: f64,
}

impl LossTerm {
    #[inline(always)]
    fn term(self, out: f32, reference: f32) -> (f64, f64) {
        let (out, reference) = (f64::from(out), f64::from(reference));
        let slope = power(out, self.gamma - 1.0);
        let difference = slope * out - reference;
        let weighed = difference / (reference * reference + self.epsilon);
        (
            difference * weighed,
            2.0 * self.share * self.gamma * slope * weighed,
        )
    }
}

struct LossOnly<'a> {
    rule: LossTerm,
    out: &'a [f32],
    reference: &'a [f32],
}

impl Leaf for LossOnly<'_> {
    type Out = f64;

    #[inline(always)]
    unsafe fn run<S: Simd>(self) -> f64 {
        let mut sums = [0.0; LANES];
        for (out, reference) in self.out.chunks(LANES).zip(self.reference.chunks(LANES)) {
            for ((out, reference), sum) in out.iter().zip(reference).zip(&mut sums) {
                *sum += self.rule.term(*out, *reference).0;
            }
        }
        sums.into_iter().sum()
    }
}

struct LossAndGradient<'a> {
    rule: LossTerm,
    out: &'a [f32],
    reference: &'a [f32],
    dout: &'a mut [f32],
}

impl Leaf for LossAndGradient<'_> {
    type Out = f64;

    #[inline(always)]
    unsafe fn run<S: Simd>(self) -> f64 {
        let mut sums = [0.0; LANES];
        let pieces = self.out.chunks(LANES).zip(self.reference.chunks(LANES));
        for ((out, reference), dout) in pieces.zip(self.dout.chunks_mut(LANES)) {
            for (((out, reference), dout), sum) in
                out.iter().zip(reference).zip(dout).zip(&mut sums)
            {
                let (term, gradient) = self.rule.term(*out, *reference);
                *sum += term;
                *dout = gradient as f32;
            }
        }
        sums.into_iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_within, bits, pattern, same_on_any_number_of_threads};

    fn images(size: usize) -> (Vec<f32>, Vec<f32>) {
        let out = pattern(size, 1)
            .iter()
            .map(|v| (2.0 * v).max(0.0))
            .collect();
        (
            out,
            pattern(size, 2).iter().map(|v| 4.0 * v.abs()).collect(),
        )
    }

    fn plain(
        out: &[f32],
        reference: &[f32],
        pixels: usize,
        gamma: f32,
        epsilon: f32,
    ) -> (f64, Vec<f64>) {
        let gamma = f64::from(gamma);
        let mut sum = 0.0;
        let gradient = out
            .iter()
            .zip(reference)
            .map(|(out, reference)| {
                let (out, reference) = (f64::from(*out), f64::from(*reference));
                let difference = out.powf(gamma) - reference;
                let share = 1.0 / (reference * reference + f64::from(epsilon)) / pixels as f64;
                sum += difference * difference * share;
                2.0 * difference * share * gamma * out.powf(gamma - 1.0)
            })
            .collect();
        (sum, gradient)
    }

    fn scale(pixels: usize, gamma: f32, epsilon: f32) -> RelMse {
        RelMse {
            pixels,
            gamma,
            epsilon,
        }
    }

    #[test]
    fn power_at_the_ends() {
        for exponent in [0.5, 1.2] {
            assert_eq!(power(0.0, exponent), 0.0);
            assert_eq!(power(-0.0, exponent), 0.0);
            assert_eq!(power(f64::INFINITY, exponent), f64::INFINITY);
            assert!(power(f64::NAN, exponent).is_nan() && power(-1.0, exponent).is_nan());
        }
        assert_eq!(power(0.0, 0.0), 1.0);
    }

    /// The gradient is one rounding to float32 away from float64.
    #[test]
    fn loss_and_gradient_are_those_of_a_plain_loop() {
        for size in [3, 12, 51, 3 * 17 * 19, TASK + 6] {
            let size = if cfg!(miri) { size.min(51) } else { size };
            let (out, reference) = images(size);
            for gamma in [2.2, 1.0, 2.4] {
                let (sum, gradient) = plain(&out, &reference, size / 3, gamma, 1e-3);
                for isa in Isa::available() {
                    let mut dout = vec![f32::NAN; size];
                    let found = loss(
                        isa,
                        &out,
                        &reference,
                        scale(size / 3, gamma, 1e-3),
                        Some(&mut dout),
                    );
                    assert!(
                        (found - sum).abs() <= 1e-8 * sum,
                        "{isa} {size}: {found}, not {sum}"
                    );
                    assert_within(&format!("{isa}, {size} values"), &dout, &gradient, 1e-7);
                    let alone = loss(isa, &out, &reference, scale(size / 3, gamma, 1e-3), None);
                    assert_eq!(alone.to_bits(), found.to_bits());
                }
            }
        }
    }

    #[test]
    fn black_output_has_no_gradient_and_the_loss_of_its_reference() {
        for isa in Isa::available() {
            let mut dout = [f32::NAN; 3];
            let found = loss(
                isa,
                &[0.0; 3],
                &[1.0; 3],
                scale(1, 2.2, 0.0),
                Some(&mut dout),
            );
            assert_eq!((found, dout), (3.0, [0.0; 3]));
        }
    }

    #[test]
    fn non_finite_values_make_the_loss_and_its_gradient_non_finite() {
        for isa in Isa::available() {
            for (bad, offset) in [
                (f32::NAN, 0),
                (f32::INFINITY, 20),
                (-1.0, 39),
                (f32::NAN, 33),
            ] {
                let (mut out, mut reference) = images(40);
                out[offset] = bad;
                let mut dout = vec![0.0; 40];
                let found = loss(isa, &out, &reference, scale(13, 2.2, 1e-3), Some(&mut dout));
                assert!(
                    !found.is_finite() && !dout[offset].is_finite(),
                    "{isa}: {bad}"
                );
                assert!(dout.iter().filter(|d| !d.is_finite()).count() == 1);
                (out[offset], reference[offset]) = (1.0, if bad == -1.0 { f32::NAN } else { bad });
                assert!(!loss(isa, &out, &reference, scale(13, 2.2, 1e-3), None).is_finite());
            }
        }
    }

    /// No operation is fused, so the bits are the same everywhere.
    #[test]
    #[cfg_attr(miri, ignore = "takes minutes")]
    fn bits_depend_neither_on_the_path_nor_on_the_threads() {
        let size = 3 * TASK + 5;
        let (out, reference) = images(size);
        let work = |isa| {
            let mut dout = vec![0.0; size];
            let sum = loss(
                isa,
                &out,
                &reference,
                scale(size / 3, 2.2, 1e-3),
                Some(&mut dout),
            );
            (sum.to_bits(), bits(&dout))
        };
        for isa in Isa::available() {
            assert!(work(isa) == work(Isa::Portable), "{isa}");
            same_on_any_number_of_threads(|| work(isa));
        }
    }
}
