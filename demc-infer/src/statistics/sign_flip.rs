//! Sign-flip test (Fisher's randomisation test for pairs) over base scenes.
//!
//! If two variants are equal, the difference of a base scene has either sign with the same
//! probability. The p-value is the share of all choices of signs whose mean is at least as far from
//! zero as the observed one.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::bootstrap::SEED;

/// Up to this number of base scenes, every choice of signs counts: 2^16. With more, as many are
/// drawn.
const EXACT_BASES: usize = 16;

/// The p-value of the differences of base scenes, two-sided.
pub(super) fn p_value(differences: &[f64]) -> f64 {
    let observed: f64 = differences.iter().sum::<f64>().abs();
    // Sums in another order differ by rounding.
    let limit = observed - 1e-9 * differences.iter().map(|value| value.abs()).sum::<f64>();
    if let 1..=EXACT_BASES = differences.len() {
        // Opposite signs give the same size, so the last one stays.
        let flips = 1_u64 << (differences.len() - 1);
        let extreme = (0..flips).filter(|signs| signed_sum(differences, *signs).abs() >= limit);
        return extreme.count() as f64 / flips as f64;
    }
    let flips = 1_u64 << EXACT_BASES;
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    // The observed signs are one of the choices.
    let extreme = (1..flips).filter(|_| {
        let sum = differences
            .chunks(64)
            .map(|part| signed_sum(part, rng.random()));
        sum.sum::<f64>().abs() >= limit
    });
    (1 + extreme.count()) as f64 / flips as f64
}

/// The sum of at most 64 values; a bit of `signs` flips its value.
fn signed_sum(values: &[f64], signs: u64) -> f64 {
    let signed = |(i, value): (usize, &f64)| if signs >> i & 1 == 1 { -value } else { *value };
    values.iter().enumerate().map(signed).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Only the observed signs and their opposite reach the sum of equal signs.
    #[test]
    fn equal_signs_have_the_smallest_p_value() {
        assert_eq!(p_value(&[1.0, 2.0, 4.0]), 2.0 / 8.0);
        assert_eq!(p_value(&[0.1; 10]), 2.0 / 1024.0);
        assert_eq!(p_value(&[0.0; 5]), 1.0);
    }

    /// Sums of +-1 +-2 +-4 are -7 to 7 in steps of 2; six of eight are at least 3 in size.
    #[test]
    fn a_case_by_hand() {
        assert_eq!(p_value(&[1.0, -2.0, 4.0]), 6.0 / 8.0);
    }

    /// The sum of 70 signs is at least 20 in size with probability 0.0229 (normal, corrected:
    /// 2 (1 - Phi(19 / sqrt(70))) = 0.0231).
    #[test]
    fn drawn_signs_agree_with_the_binomial_distribution() {
        let values: Vec<f64> = (0..70).map(|i| if i < 45 { 1.0 } else { -1.0 }).collect();
        let p = p_value(&values);
        assert!((p - 0.0230).abs() < 0.003, "{p}");
        assert_eq!(p, p_value(&values), "reproducible");
    }
}
