//! The normal distribution and Student's t distribution.

use std::f64::consts::{FRAC_1_SQRT_2, FRAC_2_PI};

/// Steps of a bisection: as many as a float64 has bits.
const BISECTIONS: usize = 52;

/// Probability that a standard normal value is below `z`.
pub(super) fn normal(z: f64) -> f64 {
    0.5 * complementary_error(-z * FRAC_1_SQRT_2)
}

/// The value below which a standard normal value lies with probability `share`, within -12 to 12.
pub(super) fn normal_quantile(share: f64) -> f64 {
    bisect([-12.0, 12.0], |z| normal(z) < share)
}

/// The value that a Student t value of `freedom` degrees of freedom exceeds in size with
/// probability `outside`.
pub(super) fn student_quantile(outside: f64, freedom: usize) -> f64 {
    let mut high = 1.0;
    while student_outside(high, freedom) > outside {
        high *= 2.0;
    }
    bisect([0.0, high], |t| student_outside(t, freedom) > outside)
}

/// Probability that a Student t value exceeds `t` in size (Abramowitz and Stegun, 26.7.3 and
/// 26.7.4).
fn student_outside(t: f64, freedom: usize) -> f64 {
    let angle = (t / (freedom as f64).sqrt()).atan();
    let (sine, cosine) = angle.sin_cos();
    let is_odd = freedom % 2 == 1;
    // Terms cos^k with factors k / (k + 1): from cos^1 for odd numbers, cos^0 for even ones.
    let mut term = if is_odd { cosine } else { 1.0 };
    let mut sum = 0.0;
    for k in (usize::from(is_odd)..freedom.saturating_sub(1)).step_by(2) {
        sum += term;
        term *= cosine * cosine * (k + 1) as f64 / (k + 2) as f64;
    }
    let inside = if is_odd {
        FRAC_2_PI * (angle + sine * sum)
    } else {
        sine * sum
    };
    1.0 - inside
}

/// The complementary error function with a relative error below 1.2e-7 (Press et al., Numerical
/// Recipes, `erfcc`).
fn complementary_error(x: f64) -> f64 {
    const SERIES: [f64; 10] = [
        -1.26551223,
        1.00002368,
        0.37409196,
        0.09678418,
        -0.18628806,
        0.27886807,
        -1.13520398,
        1.48851587,
        -0.82215223,
        0.17087277,
    ];
    let t = 1.0 / (1.0 + 0.5 * x.abs());
    let exponent = SERIES
        .iter()
        .rev()
        .fold(0.0, |sum, factor| sum * t + factor);
    let above = t * (exponent - x * x).exp();
    if x >= 0.0 { above } else { 2.0 - above }
}

/// The place between `low` and `high` where `is_below` changes from true to false.
fn bisect([mut low, mut high]: [f64; 2], is_below: impl Fn(f64) -> bool) -> f64 {
    for _ in 0..BISECTIONS {
        let middle = 0.5 * (low + high);
        if is_below(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: f64, expected: f64, tolerance: f64) {
        assert!((found - expected).abs() < tolerance, "{found} {expected}");
    }

    /// Values of printed tables.
    #[test]
    fn quantiles_are_those_of_tables() {
        near(normal(1.0), 0.841_345, 1e-6);
        near(normal(-3.0), 0.001_349_9, 1e-6);
        near(normal_quantile(0.975), 1.959_964, 1e-5);
        near(normal_quantile(0.8), 0.841_621, 1e-5);
        for (freedom, expected) in [
            (1, 12.7062),
            (2, 4.3027),
            (3, 3.1824),
            (4, 2.7764),
            (12, 2.1788),
            (23, 2.0687),
        ] {
            near(student_quantile(0.05, freedom), expected, 1e-4);
        }
        near(student_quantile(0.01, 5), 4.0321, 1e-4);
    }

    #[test]
    fn many_degrees_of_freedom_are_the_normal_distribution() {
        near(student_quantile(0.05, 100_000), 1.959_99, 1e-4);
    }
}
