//! The norm of a gradient and its scaling: passes over all weights.

use crate::Isa;
use crate::simd::{self, Leaf, Simd};
use crate::tasks::{self, TASK};

/// Number of independent partial sums.
const LANES: usize = 16;

/// Sum of the squares of `values` in float64, where squares of float32 neither overflow nor vanish.
/// NaN or infinite if a value is.
pub fn sum_of_squares(isa: Isa, values: &[f32]) -> f64 {
    let sums = tasks::map(values.chunks(TASK), |values| {
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(isa, SumOfSquares { values }) }
    });
    sums.into_iter().sum()
}

/// Multiplies `values` by `factor`.
pub fn scale(isa: Isa, values: &mut [f32], factor: f32) {
    tasks::each(values.chunks_mut(TASK), |values| {
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(tasks::streaming(isa), ScaleValues { values, factor }) }
    });
}

struct SumOfSquares<'a> {
    values: &'a [f32],
}

impl Leaf for SumOfSquares<'_> {
    type Out = f64;

    #[inline(always)]
    unsafe fn run<S: Simd>(self) -> f64 {
        let mut sums = [0.0f64; LANES];
        let (whole, rest) = self.values.as_chunks::<LANES>();
        for values in whole {
            for (sum, value) in sums.iter_mut().zip(values) {
                *sum += f64::from(*value) * f64::from(*value);
            }
        }
        for (sum, value) in sums.iter_mut().zip(rest) {
            *sum += f64::from(*value) * f64::from(*value);
        }
        sums.into_iter().sum()
    }
}

struct ScaleValues<'a> {
    values: &'a mut [f32],
    factor: f32,
}

impl Leaf for ScaleValues<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        for value in self.values {
            *value *= self.factor;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{bits, pattern, same_on_any_number_of_threads};

    const LONG: usize = if cfg!(miri) { 100 } else { 2 * TASK + 13 };
    const SIZES: [usize; 4] = [0, 1, 37, LONG];

    #[test]
    fn sums_are_those_of_a_plain_loop() {
        for isa in Isa::available() {
            for size in SIZES {
                let values = pattern(size, 1);
                let expected: f64 = values.iter().map(|v| f64::from(*v).powi(2)).sum();
                let found = sum_of_squares(isa, &values);
                assert!(
                    (found - expected).abs() <= 1e-13 * expected,
                    "{isa} {size}: {found}, not {expected}"
                );
            }
        }
    }

    #[test]
    fn the_range_of_float32_does_not_overflow_and_nan_is_seen() {
        for isa in Isa::available() {
            assert!(sum_of_squares(isa, &[1e30; 40]) > 3.9e61);
            assert!(sum_of_squares(isa, &[1e-30; 40]) > 3.9e-59);
            for offset in [0, 16, 39] {
                let mut values = vec![1.0; 40];
                values[offset] = f32::NAN;
                assert!(sum_of_squares(isa, &values).is_nan());
            }
        }
    }

    #[test]
    fn scaling_multiplies_each_value() {
        for isa in Isa::available() {
            for size in SIZES {
                let (before, mut values) = (pattern(size, 2), pattern(size, 2));
                scale(isa, &mut values, 0.3);
                let expected: Vec<f32> = before.iter().map(|v| v * 0.3).collect();
                assert!(bits(&values) == bits(&expected), "{isa} {size}");
            }
        }
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes minutes")]
    fn sums_have_the_same_bits_on_any_number_of_threads() {
        let values = pattern(5 * TASK + 7, 3);
        for isa in Isa::available() {
            same_on_any_number_of_threads(|| sum_of_squares(isa, &values).to_bits());
        }
    }
}
