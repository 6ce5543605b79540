//! Adam (Kingma and Ba 2014) in one pass over weight, gradient and moments.
//!
//! The operations and their order are Burn's (burn-optim 0.22), each rounded once: the same bits as
//! its Adam, on every path. The bias corrections are moved from the moments to the step size and
//! epsilon (end of their Sec. 2).

use crate::Isa;
use crate::simd::{self, Leaf, Simd};
use crate::tasks::{self, TASK};

/// Hyperparameters of Adam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adam {
    /// Learning rate.
    pub lr: f32,
    /// Decay of the first moment per step.
    pub beta_1: f32,
    /// Decay of the second moment per step.
    pub beta_2: f32,
    /// Added to the square root of the second moment, in units of the gradient.
    pub epsilon: f32,
}

/// A weight tensor and its moments, which are 0 before step 1. All have one length.
#[derive(Debug)]
pub struct AdamWeight<'a> {
    /// Weight.
    pub weight: &'a mut [f32],
    /// First moment.
    pub first: &'a mut [f32],
    /// Second moment.
    pub second: &'a mut [f32],
}

/// Updates one weight tensor and its moments by one step. `step` counts from 1.
///
/// # Shapes
/// `grad` has the length of the weight.
///
/// # Panics
/// If the lengths differ, or at step 0.
pub fn step(isa: Isa, rule: &Adam, step: u64, weight: AdamWeight, grad: &[f32]) {
    let AdamWeight {
        weight,
        first,
        second,
    } = weight;
    let lengths = [grad.len(), first.len(), second.len()];
    assert_eq!(
        lengths,
        [weight.len(); 3],
        "grad, first and second moment of a weight of {} values",
        weight.len()
    );
    let factors = StepFactors::new(rule, step);
    let moments = first.chunks_mut(TASK).zip(second.chunks_mut(TASK));
    let pieces = weight.chunks_mut(TASK).zip(grad.chunks(TASK)).zip(moments);
    tasks::each(pieces, |((weight, grad), (first, second))| {
        let leaf = AdamStep {
            factors,
            weight,
            grad,
            first,
            second,
        };
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });
}

#[derive(Clone, Copy)]
struct StepFactors {
    beta_1: f32,
    rest_1: f32,
    beta_2: f32,
    rest_2: f32,
    correction: f32,
    epsilon: f32,
    lr: f32,
}

impl StepFactors {
    fn new(rule: &Adam, step: u64) -> Self {
        assert!(step > 0, "steps count from 1");
        // Beyond 2^31 steps both powers are 0.
        let time = i32::try_from(step).unwrap_or(i32::MAX);
        let root = (1.0 - rule.beta_2.powi(time)).sqrt();
        StepFactors {
            beta_1: rule.beta_1,
            rest_1: 1.0 - rule.beta_1,
            beta_2: rule.beta_2,
            rest_2: 1.0 - rule.beta_2,
            correction: root / (1.0 - rule.beta_1.powi(time)),
            epsilon: rule.epsilon * root,
            lr: rule.lr,
        }
    }
}

struct AdamStep<'a> {
    factors: StepFactors,
    weight: &'a mut [f32],
    grad: &'a [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
}

impl Leaf for AdamStep<'_> {
    type Out = ();

    /// A plain loop that the compiler vectorises for the path. Products and sums must not be fused.
    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let f = self.factors;
        let moments = self.first.iter_mut().zip(self.second);
        for ((weight, grad), (first, second)) in self.weight.iter_mut().zip(self.grad).zip(moments)
        {
            *first = *first * f.beta_1 + grad * f.rest_1;
            *second = *second * f.beta_2 + grad * grad * f.rest_2;
            *weight -= *first * f.correction / (second.sqrt() + f.epsilon) * f.lr;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_within, bits, pattern, same_on_any_number_of_threads};

    const RULE: Adam = Adam {
        lr: 1e-2,
        beta_1: 0.9,
        beta_2: 0.999,
        epsilon: 1e-8,
    };

    fn run(isa: Isa, size: usize, steps: u64) -> [Vec<f32>; 3] {
        let (mut weight, mut first, mut second) =
            (pattern(size, 1), vec![0.0; size], vec![0.0; size]);
        for t in 1..=steps {
            step(
                isa,
                &RULE,
                t,
                AdamWeight {
                    weight: &mut weight,
                    first: &mut first,
                    second: &mut second,
                },
                &pattern(size, 1 + t as u32),
            );
        }
        [weight, first, second]
    }

    fn paper(size: usize, steps: u64) -> [Vec<f64>; 3] {
        let float64 =
            |values: Vec<f32>| -> Vec<f64> { values.into_iter().map(f64::from).collect() };
        let [lr, b1, b2, epsilon] = [1e-2, 0.9, 0.999, 1e-8];
        let (mut weight, mut first, mut second) =
            (float64(pattern(size, 1)), vec![0.0; size], vec![0.0; size]);
        for t in 1..=steps {
            for (i, g) in float64(pattern(size, 1 + t as u32)).into_iter().enumerate() {
                first[i] = b1 * first[i] + (1.0 - b1) * g;
                second[i] = b2 * second[i] + (1.0 - b2) * g * g;
                let hat = (
                    first[i] / (1.0 - b1.powi(t as i32)),
                    second[i] / (1.0 - b2.powi(t as i32)),
                );
                weight[i] -= lr * hat.0 / (f64::sqrt(hat.1) + epsilon);
            }
        }
        [weight, first, second]
    }

    /// Each step has three roundings of values of order 1. float32 holds the decays to 1e-8 of 1 -
    /// 0.999.
    #[test]
    #[cfg_attr(miri, ignore = "Miri rounds powi at random")]
    fn steps_are_those_of_the_paper() {
        for size in [1, 5, 16, 129, TASK + 3] {
            let expected = paper(size, 4);
            for isa in Isa::available() {
                for (found, expected) in run(isa, size, 4).iter().zip(&expected) {
                    assert_within(&format!("{isa}, {size} values"), found, expected, 1e-6);
                }
            }
        }
    }

    /// The tensor operations of burn-optim 0.22.1's `AdaptiveMomentum::transform`, one by one.
    #[test]
    #[cfg_attr(miri, ignore = "Miri rounds powi at random")]
    fn bits_are_those_of_burns_operations() {
        let size = 133;
        let (mut weight, mut first, mut second) =
            (pattern(size, 1), vec![0.0f32; size], vec![0.0f32; size]);
        for t in 1..=3i32 {
            // Constant powers would be folded by the compiler, which rounds them in its own way.
            let t = std::hint::black_box(t);
            for (i, g) in pattern(size, 1 + t as u32).into_iter().enumerate() {
                let (scaled, decayed) = (g * (1.0 - RULE.beta_1), first[i] * RULE.beta_1);
                first[i] = decayed + scaled;
                let (scaled, decayed) = ((g * g) * (1.0 - RULE.beta_2), second[i] * RULE.beta_2);
                second[i] = decayed + scaled;
                let root = (1.0 - RULE.beta_2.powi(t)).sqrt();
                let combined = root / (1.0 - RULE.beta_1.powi(t));
                let divided = (first[i] * combined) / (second[i].sqrt() + RULE.epsilon * root);
                weight[i] -= divided * RULE.lr;
            }
        }
        let expected = [weight, first, second].map(|values| bits(&values));
        for isa in Isa::available() {
            assert!(
                run(isa, size, 3).map(|values| bits(&values)) == expected,
                "{isa}"
            );
        }
    }

    #[test]
    #[cfg_attr(miri, ignore = "Miri rounds powi at random")]
    fn bits_do_not_depend_on_the_threads() {
        let size = 3 * TASK + 5;
        for isa in Isa::available() {
            same_on_any_number_of_threads(|| run(isa, size, 1).map(|values| bits(&values)));
        }
    }

    #[test]
    fn a_nan_gradient_reaches_the_weight() {
        for isa in Isa::available() {
            let mut weight = [1.0; 3];
            step(
                isa,
                &RULE,
                1,
                AdamWeight {
                    weight: &mut weight,
                    first: &mut [0.0; 3],
                    second: &mut [0.0; 3],
                },
                &[0.0, f32::NAN, 1.0],
            );
            assert!(weight[0] == 1.0 && weight[1].is_nan() && weight[2].is_finite());
        }
    }

    #[test]
    #[should_panic(expected = "of a weight of 2 values")]
    fn lengths_are_checked() {
        step(
            Isa::Portable,
            &RULE,
            1,
            AdamWeight {
                weight: &mut [0.0; 2],
                first: &mut [0.0; 2],
                second: &mut [0.0; 2],
            },
            &[0.0; 3],
        );
    }
}
