//! Compares with plain float64 loops, for large, constant and non-finite values.

use super::*;
use crate::testing::{assert_within, bits, pattern, same_on_any_number_of_threads};

const EPSILON: f32 = 1e-3;

/// Pixels and channels: a single value, partly filled vectors, several blocks, a block with part of
/// a row.
fn sizes() -> Vec<(usize, usize)> {
    let all = [
        (1, 1),
        (1, 17),
        (35, 3),
        (35, 64),
        (6, 512),
        (4100, 12),
        (5000, 1),
        (1500, 65),
        (700, 48),
        (40, 1000),
    ];
    let few = if cfg!(miri) { 3 } else { all.len() };
    all[..few].to_vec()
}

struct Case {
    x: Vec<f32>,
    gamma: Vec<f32>,
    beta: Vec<f32>,
    dy: Vec<f32>,
}

fn case(pixels: usize, channels: usize) -> Case {
    let by_channel = |seed| pattern(channels, seed);
    let (center, spread) = (by_channel(1), by_channel(2));
    let x = pattern(pixels * channels, 3);
    let x = x.iter().enumerate().map(|(i, x)| {
        let c = i % channels;
        x * (1.5 + spread[c]) + 3.0 * center[c]
    });
    Case {
        x: x.collect(),
        gamma: by_channel(4).iter().map(|g| g + 1.5).collect(),
        beta: by_channel(5),
        dy: pattern(pixels * channels, 6),
    }
}

struct KernelResult {
    y: Vec<f32>,
    mean: Vec<f32>,
    variance: Vec<f32>,
    dx: Vec<f32>,
    dgamma: Vec<f32>,
    dbeta: Vec<f32>,
}

fn found(isa: Isa, case: &Case, relu: bool) -> KernelResult {
    let (len, channels) = (case.x.len(), case.gamma.len());
    let map = || vec![f32::NAN; len];
    let row = || vec![f32::NAN; channels];
    let (mut y, mut mean, mut variance) = (map(), row(), row());
    forward_train(
        isa,
        &case.x,
        BatchNorm {
            gamma: &case.gamma,
            beta: &case.beta,
            epsilon: EPSILON,
            relu,
        },
        &mut y,
        Moments {
            mean: &mut mean,
            variance: &mut variance,
        },
    );
    let (mut dx, mut dgamma, mut dbeta) = (map(), row(), row());
    let gate = relu.then_some(&y[..]);
    let source = BatchNormSource {
        x: &case.x,
        gamma: &case.gamma,
        moments: Moments {
            mean: &mean,
            variance: &variance,
        },
        epsilon: EPSILON,
        y: gate,
        dy: &case.dy,
    };
    backward(isa, source, &mut dx, &mut dgamma, &mut dbeta);
    KernelResult {
        y,
        mean,
        variance,
        dx,
        dgamma,
        dbeta,
    }
}

/// Compares with plain loops in float64. Gates come from the float32 output, which may flip for a
/// value near 0.
fn check_case(isa: Isa, case: &Case, relu: bool, what: &str) {
    let channels = case.gamma.len();
    let found = found(isa, case, relu);
    let n = (case.x.len() / channels) as f64;
    let len = case.x.len();
    let (mut y, mut dx) = (vec![0.0; len], vec![0.0; len]);
    let [mut means, mut variances, mut dgamma, mut dbeta] = [0; 4].map(|_| vec![0.0; channels]);
    for c in 0..channels {
        let column = || (c..len).step_by(channels);
        let x = |i: usize| f64::from(case.x[i]);
        let g = |i: usize| {
            if relu && found.y[i] <= 0.0 {
                0.0
            } else {
                f64::from(case.dy[i])
            }
        };
        means[c] = column().map(x).sum::<f64>() / n;
        variances[c] = column().map(|i| (x(i) - means[c]).powi(2)).sum::<f64>() / n;
        let s = 1.0 / (variances[c] + f64::from(EPSILON)).sqrt();
        let hat = |i| (x(i) - means[c]) * s;
        let gamma = f64::from(case.gamma[c]);
        dbeta[c] = column().map(g).sum();
        dgamma[c] = column().map(|i| g(i) * hat(i)).sum();
        for i in column() {
            y[i] = hat(i) * gamma + f64::from(case.beta[c]);
            y[i] = if relu { y[i].max(0.0) } else { y[i] };
            dx[i] = gamma * s * (g(i) - dbeta[c] / n - hat(i) * dgamma[c] / n);
        }
    }
    // Means are exact to one rounding of values up to 5. The factor s reaches 32 where one pixel
    // has no spread.
    assert_within(&format!("mean, {what}"), &found.mean, &means, 2e-7);
    assert_within(
        &format!("variance, {what}"),
        &found.variance,
        &variances,
        2e-7,
    );
    assert_within(&format!("y, {what}"), &found.y, &y, 5e-6);
    // Sums of up to 5000 terms of order 1; float32 adds up to a few hundred of them.
    assert_within(&format!("dbeta, {what}"), &found.dbeta, &dbeta, 1e-5);
    assert_within(&format!("dgamma, {what}"), &found.dgamma, &dgamma, 1e-5);
    assert_within(&format!("dx, {what}"), &found.dx, &dx, 1e-5);
}

#[test]
fn forward_and_backward_are_those_of_plain_loops() {
    for (pixels, channels) in sizes() {
        let case = case(pixels, channels);
        for isa in Isa::available() {
            for relu in [false, true] {
                check_case(
                    isa,
                    &case,
                    relu,
                    &format!("{isa}, {pixels} px of {channels}, relu {relu}"),
                );
            }
        }
    }
}

/// A mean of a thousand deviations that drifts over the map, and an outlier as the first pixel.
#[test]
fn variance_beside_a_large_mean_is_exact() {
    let pixels = if cfg!(miri) { 600 } else { 40_000 };
    let mut x = pattern(pixels * 3, 1);
    let drift = |i: usize| 1000.0 + i as f32 / (pixels * 3) as f32;
    x.iter_mut().enumerate().for_each(|(i, x)| *x += drift(i));
    x[..3].fill(0.0);
    for isa in Isa::available() {
        let (mut mean, mut variance) = ([0.0; 3], [0.0; 3]);
        statistics(isa, &x, &mut mean, &mut variance);
        for c in 0..3 {
            let column = || x.iter().skip(c).step_by(3).map(|x| f64::from(*x));
            let center = column().sum::<f64>() / pixels as f64;
            let spread = column().map(|x| (x - center).powi(2)).sum::<f64>() / pixels as f64;
            assert!((f64::from(mean[c]) - center).abs() < 1e-7 * center, "{isa}");
            assert!(
                (f64::from(variance[c]) - spread).abs() < 1e-5 * spread,
                "{isa}: {variance:?}, not {spread}"
            );
        }
    }
}

#[test]
fn a_constant_map_becomes_beta() {
    for isa in Isa::available() {
        let (mut y, mut mean, mut variance) = ([0.0; 99], [0.0; 3], [0.0; 3]);
        let beta = [0.5, 0.25, -0.5];
        forward_train(
            isa,
            &[0.3; 99],
            BatchNorm {
                gamma: &[2.0; 3],
                beta: &beta,
                epsilon: EPSILON,
                relu: false,
            },
            &mut y,
            Moments {
                mean: &mut mean,
                variance: &mut variance,
            },
        );
        assert_eq!((mean, variance), ([0.3; 3], [0.0; 3]));
        assert!(y.iter().enumerate().all(|(i, y)| *y == beta[i % 3]));
    }
}

/// No operation is fused, so the bits are the same everywhere.
#[test]
#[cfg_attr(miri, ignore = "takes minutes")]
fn bits_depend_neither_on_the_path_nor_on_the_threads() {
    let case = case(3000, 17);
    let work = |isa| {
        let f = found(isa, &case, true);
        [f.y, f.mean, f.variance, f.dx, f.dgamma, f.dbeta].map(|values| bits(&values))
    };
    for isa in Isa::available() {
        assert!(work(isa) == work(Isa::Portable), "{isa}");
        same_on_any_number_of_threads(|| work(isa));
    }
}

#[test]
fn non_finite_values_pass_through_the_relu() {
    for isa in Isa::available() {
        let mut case = case(40, 3);
        case.x[10] = f32::NAN;
        let found = found(isa, &case, true);
        assert!(
            found
                .y
                .iter()
                .enumerate()
                .all(|(i, y)| y.is_nan() == (i % 3 == 1)),
            "{isa}"
        );
        let mut y = [0.0; 3];
        let x = [f32::INFINITY, f32::NAN, -1.0];
        let norm = BatchNorm {
            gamma: &[1.0; 3],
            beta: &[0.0; 3],
            epsilon: 0.0,
            relu: true,
        };
        let moments = Moments {
            mean: &[0.0; 3][..],
            variance: &[1.0; 3],
        };
        forward_eval(isa, &x, norm, moments, &mut y);
        assert!(
            y[0] == f32::INFINITY && y[1].is_nan() && y[2] == 0.0,
            "{isa}: {y:?}"
        );
    }
}

#[test]
#[should_panic(expected = "10 values are no map of 3 channels")]
fn lengths_are_checked() {
    let norm = BatchNorm {
        gamma: &[0.0; 3],
        beta: &[0.0; 3],
        epsilon: 0.0,
        relu: true,
    };
    let moments = Moments {
        mean: &[0.0; 3][..],
        variance: &[0.0; 3],
    };
    forward_eval(Isa::Portable, &[0.0; 10], norm, moments, &mut [0.0; 10]);
}
