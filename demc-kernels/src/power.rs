//! Powers of float32 values, computed in float64, and exponentials. The bits are the same on every
//! path and platform, and the compiler vectorises the loops.

use std::f64::consts::{LN_2, LOG2_E, SQRT_2};

use crate::Isa;
use crate::simd::{self, Leaf, Simd};
use crate::tasks::{self, TASK};

/// Replaces each value by `max(x, 0)^exponent`, exact to float32. NaN stays NaN.
///
/// # Panics
/// If the exponent is not between 0 and 5.
pub fn positive_powers(isa: Isa, values: &mut [f32], exponent: f32) {
    assert!(
        (0.0..=5.0).contains(&exponent),
        "exponent {exponent} is not between 0 and 5"
    );
    tasks::each(values.chunks_mut(TASK), |values| {
        let leaf = Powers {
            values,
            exponent: f64::from(exponent),
        };
        // SAFETY: the leaf accesses memory through a slice only.
        unsafe { simd::run(isa, leaf) }
    });
}

struct Powers<'a> {
    values: &'a mut [f32],
    exponent: f64,
}

impl Leaf for Powers<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        for value in self.values {
            let positive = if *value < 0.0 { 0.0 } else { *value };
            *value = power(f64::from(positive), self.exponent) as f32;
        }
    }
}

/// `x^exponent` to 1e-9, for float32 `x` and exponents from 0 to 5. It is 0 at 0 (1 for exponent
/// 0), and NaN for negative `x`.
///
/// `x = 2^e * m` with m from sqrt(1/2) to sqrt(2). This keeps two series short: that of log2(m) in
/// `s = (m - 1) / (m + 1)` below 0.172, and that of 2^r for r from -1/2 to 1/2. There is no branch,
/// so the compiler vectorises loops around it.
#[inline(always)]
pub(crate) fn power(x: f64, exponent: f64) -> f64 {
    // The bits of 1: the exponent of float64 has a bias of 1023 and is stored above 52 bits of
    // mantissa.
    const ONE: u64 = 1023 << 52;
    const ROOT_HALF: u64 = (SQRT_2 / 2.0).to_bits();
    /// Added to an integer below 2^51, this leaves its bits at the low end of the mantissa.
    const SHIFT: f64 = 1.5 * (1u64 << 52) as f64;

    let bits = x.to_bits().wrapping_add(ONE - ROOT_HALF);
    let e = f64::from_bits((bits >> 52) | SHIFT.to_bits()) - (SHIFT + 1023.0);
    let m = f64::from_bits((bits & ((1 << 52) - 1)).wrapping_add(ROOT_HALF));

    // ln(m) = 2 (s + s^3/3 + s^5/5 + ...). The first omitted term is s^13/13, 5e-11 of the first.
    let s = (m - 1.0) / (m + 1.0);
    let s2 = s * s;
    let series = 1.0
        + s2 * (1.0 / 3.0
            + s2 * (1.0 / 5.0 + s2 * (1.0 / 7.0 + s2 * (1.0 / 9.0 + s2 * (1.0 / 11.0)))));
    let log2 = e + 2.0 * LOG2_E * s * series;

    let whole = exponent * log2 + SHIFT;
    let n = whole - SHIFT;
    // exp(z) = 1 + z/1 (1 + z/2 (1 + z/3 (...))). The first omitted term is z^9/9!, below 2e-10.
    let z = (exponent * log2 - n) * LN_2;
    let mut series = 1.0 + z / 8.0;
    series = 1.0 + z * (1.0 / 7.0) * series;
    series = 1.0 + z * (1.0 / 6.0) * series;
    series = 1.0 + z * (1.0 / 5.0) * series;
    series = 1.0 + z * (1.0 / 4.0) * series;
    series = 1.0 + z * (1.0 / 3.0) * series;
    series = 1.0 + z * (1.0 / 2.0) * series;
    series = 1.0 + z * series;
    let scale = f64::from_bits((whole.to_bits() << 52).wrapping_add(ONE));

    // 0, infinity and NaN have no such parts; negative values have no power.
    let plain = series * scale;
    let at_zero = if exponent == 0.0 { 1.0 } else { 0.0 };
    let not_negative = if x == 0.0 { at_zero } else { x };
    let other = if x < 0.0 { f64::NAN } else { not_negative };
    if x > 0.0 && x < f64::INFINITY {
        plain
    } else {
        other
    }
}

/// `e^x` to 2e-7 for x up to 0; 0 below -87. NaN stays NaN.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    /// Added to an integer below 2^22, this leaves its bits at the low end of the mantissa.
    const SHIFT: f32 = 1.5 * (1u32 << 23) as f32;
    const LOG2_E: f32 = std::f32::consts::LOG2_E;
    // Two parts of ln(2); the first has few bits, so that its product with an integer is exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let clamped = if x < -87.0 { -87.0 } else { x };
    let whole = clamped * LOG2_E + SHIFT;
    let n = whole - SHIFT;
    let z = (clamped - n * LN2_HIGH) - n * LN2_LOW;
    // exp(z) = 1 + z/1 (1 + z/2 (1 + z/3 (...))), |z| below 0.35.
    let mut series = 1.0 + z * (1.0 / 7.0);
    series = 1.0 + z * (1.0 / 6.0) * series;
    series = 1.0 + z * (1.0 / 5.0) * series;
    series = 1.0 + z * (1.0 / 4.0) * series;
    series = 1.0 + z * (1.0 / 3.0) * series;
    series = 1.0 + z * (1.0 / 2.0) * series;
    series = 1.0 + z * series;
    let scale = f32::from_bits((whole.to_bits() << 23).wrapping_add(1.0f32.to_bits()));
    if x < -87.0 { 0.0 } else { series * scale }
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    let small = exp(-x.abs());
    let positive = 1.0 / (1.0 + small);
    if x < 0.0 { small * positive } else { positive }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{bits, pattern, same_on_any_number_of_threads};

    #[test]
    fn power_is_that_of_the_standard_library() {
        for exponent in [0.0, 0.5, 1.0, f64::from(2.2f32) - 1.0, 1.4, 5.0] {
            // Every binade of float32, including subnormal ones.
            for i in 0..254 * 8 {
                let x = f64::from(f32::from_bits((i << 20) + 12345 + i));
                let (found, expected) = (power(x, exponent), x.powf(exponent));
                assert!(
                    (found - expected).abs() <= 1e-9 * expected,
                    "{x}^{exponent}: {found}, not {expected}"
                );
            }
        }
        assert_eq!(power(1.0, 1.2), 1.0);
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes minutes")]
    fn powers_are_those_of_positive_values_on_every_path() {
        let mut x = pattern(2 * TASK + 5, 1);
        x[7] = f32::NAN;
        for exponent in [1.0 / 2.2f32, 2.2] {
            let work = |isa| {
                let mut values = x.clone();
                positive_powers(isa, &mut values, exponent);
                values
            };
            let portable = work(Isa::Portable);
            for (found, x) in portable.iter().zip(&x) {
                let expected = f64::from(x.max(0.0)).powf(f64::from(exponent)) as f32;
                assert!(
                    x.is_nan() && found.is_nan() || (found - expected).abs() <= 1e-7 * expected,
                    "{x}"
                );
            }
            for isa in Isa::available() {
                assert_eq!(bits(&work(isa)), bits(&portable), "{isa}");
                same_on_any_number_of_threads(|| bits(&work(isa)));
            }
        }
    }

    #[test]
    fn exponentials_are_those_of_the_standard_library() {
        for i in 0..=9000 {
            let x = -0.01 * i as f32;
            let expected = if x < -87.0 { 0.0 } else { f64::from(x).exp() };
            assert!(
                (f64::from(exp(x)) - expected).abs() <= 2e-7 * expected,
                "{x}"
            );
            for x in [x, -x] {
                let expected = 1.0 / (1.0 + (-f64::from(x)).exp());
                assert!((f64::from(sigmoid(x)) - expected).abs() <= 3e-7, "{x}");
            }
        }
        assert!(exp(f32::NAN).is_nan() && sigmoid(f32::NAN).is_nan());
    }
}
