//! Batch normalisation (Ioffe and Szegedy 2015) with the ReLU after it.
//!
//! Channels come last, so a per-channel parameter is repeated to the length of a *row* of pixels: passes are then plain
//! loops over rows, which the compiler vectorises whatever the channels. Sums are taken along the columns of such rows
//! in float32 over a *block* of fixed size, and over its blocks in float64, in order.
//!
//! NaN and infinite values reach the output: ReLU lets NaN through.

mod passes;

use passes::{GradientSums, InputGradient, Moments, Normalize};

use crate::Isa;
use crate::simd;
use crate::tasks::{self, TASK};

/// Least values of a row.
const ROW: usize = 512;

/// Values of a block, about: 128 KiB, which a core's own cache holds for a second look.
const BLOCK: usize = 2 * TASK;

/// Normalises by the batch's own statistics: `y = (x - mean) / sqrt(variance + epsilon) * gamma + beta`, rectified where
/// asked, and returns them: the mean and the biased variance over all pixels, by channel.
///
/// # Shapes
/// `x` and `y`: `[pixels, channels]`; the others `[channels]`.
///
/// # Panics
/// Where the lengths do not fit, or for maps without a pixel.
#[allow(clippy::too_many_arguments, reason = "what the operation is")]
pub fn forward_train(
    isa: Isa,
    x: &[f32],
    gamma: &[f32],
    beta: &[f32],
    epsilon: f32,
    relu: bool,
    y: &mut [f32],
    mean: &mut [f32],
    variance: &mut [f32],
) {
    check(
        x.len(),
        gamma.len(),
        &[beta.len(), mean.len(), variance.len()],
    );
    statistics(isa, x, mean, variance);
    forward_eval(isa, x, gamma, beta, mean, variance, epsilon, relu, y);
}

/// Normalises by given statistics: `y = (x - mean) / sqrt(variance + epsilon) * gamma + beta`, rectified where asked.
///
/// # Shapes
/// `x` and `y`: `[pixels, channels]`; the others `[channels]`.
///
/// # Panics
/// Where the lengths do not fit, or for maps without a pixel.
#[allow(clippy::too_many_arguments, reason = "what the operation is")]
pub fn forward_eval(
    isa: Isa,
    x: &[f32],
    gamma: &[f32],
    beta: &[f32],
    mean: &[f32],
    variance: &[f32],
    epsilon: f32,
    relu: bool,
    y: &mut [f32],
) {
    let channels = gamma.len();
    check(x.len(), channels, &[beta.len(), mean.len(), variance.len()]);
    assert_eq!(x.len(), y.len(), "maps of one size");
    let scale = scales(gamma, variance, epsilon);
    let rows = Rows::new(x.len(), channels);
    let [mean, scale, beta] = [mean, &scale, beta].map(|values| rows.repeated(values));
    let [mean, scale, beta] = [&mean[..], &scale, &beta];
    let pieces = x.chunks(rows.block).zip(y.chunks_mut(rows.block));
    tasks::each(pieces, |(x, y)| {
        let leaf = Normalize {
            x,
            mean,
            scale,
            beta,
            relu,
            y,
        };
        // SAFETY: the leaf has slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });
}

/// Gradients of [`forward_train`] with the statistics that it returned, which depend on `x` themselves. Where the output
/// was rectified, `y` is that output: `dy` then counts only where `y` is positive. All three gradients are overwritten.
///
/// # Shapes
/// `x`, `y`, `dy` and `dx`: `[pixels, channels]`; the others `[channels]`.
///
/// # Panics
/// Where the lengths do not fit, or for maps without a pixel.
#[allow(clippy::too_many_arguments, reason = "what the operation is")]
pub fn backward(
    isa: Isa,
    x: &[f32],
    gamma: &[f32],
    mean: &[f32],
    variance: &[f32],
    epsilon: f32,
    y: Option<&[f32]>,
    dy: &[f32],
    dx: &mut [f32],
    dgamma: &mut [f32],
    dbeta: &mut [f32],
) {
    let channels = gamma.len();
    check(
        x.len(),
        channels,
        &[mean.len(), variance.len(), dgamma.len(), dbeta.len()],
    );
    let maps = [y.map_or(x.len(), <[f32]>::len), dy.len(), dx.len()];
    assert_eq!(
        maps,
        [x.len(); 3],
        "y, dy and dx beside a map of {} values",
        x.len()
    );
    // Without a ReLU any map does as `y`.
    let (gated, y) = (y.is_some(), y.unwrap_or(dy));

    let rows = Rows::new(x.len(), channels);
    let means = &rows.repeated(mean)[..];
    let maps = || {
        x.chunks(rows.block)
            .zip(y.chunks(rows.block))
            .zip(dy.chunks(rows.block))
    };
    let sums = tasks::map(maps(), |((x, y), dy)| {
        let leaf = GradientSums {
            x,
            y,
            dy,
            gated,
            mean: means,
            channels,
        };
        // SAFETY: the leaf has slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });

    // With g = dy behind the gate, n pixels and s = 1 / sqrt(variance + epsilon):
    //   dbeta = sum g, dgamma = s sum g (x - mean), dx = gamma s (g - dbeta / n - (x - mean) s dgamma / n).
    let pixels = (x.len() / channels) as f64;
    let scale = scales(gamma, variance, epsilon);
    let (mut slope, mut shift) = (vec![0.0; channels], vec![0.0; channels]);
    for c in 0..channels {
        let [plain, by_x] = sums.iter().fold([0.0; 2], |sum, block| {
            [sum[0] + block[c][0], sum[1] + block[c][1]]
        });
        let s = inverse_deviation(variance[c], epsilon);
        dbeta[c] = plain as f32;
        dgamma[c] = (s * by_x) as f32;
        slope[c] = (-f64::from(scale[c]) * s * s * by_x / pixels) as f32;
        shift[c] = (-f64::from(scale[c]) * plain / pixels) as f32;
    }
    let [scale, slope, shift] = [&scale, &slope, &shift].map(|values| rows.repeated(values));
    let [scale, slope, shift] = [&scale[..], &slope, &shift];
    tasks::each(
        maps().zip(dx.chunks_mut(rows.block)),
        |(((x, y), dy), dx)| {
            let leaf = InputGradient {
                x,
                y,
                dy,
                gated,
                mean: means,
                scale,
                slope,
                shift,
                dx,
            };
            // SAFETY: the leaf has slices only.
            unsafe { simd::run(tasks::streaming(isa), leaf) }
        },
    );
}

#[track_caller]
fn check(len: usize, channels: usize, parameters: &[usize]) {
    assert!(
        channels > 0 && len > 0 && len.is_multiple_of(channels),
        "{len} values are no map of {channels} channels"
    );
    for found in parameters {
        assert_eq!(
            *found, channels,
            "a parameter's length for {channels} channels"
        );
    }
}

fn inverse_deviation(variance: f32, epsilon: f32) -> f64 {
    1.0 / (f64::from(variance) + f64::from(epsilon)).sqrt()
}

fn scales(gamma: &[f32], variance: &[f32], epsilon: f32) -> Vec<f32> {
    let scale = |(gamma, variance): (&f32, &f32)| {
        (f64::from(*gamma) * inverse_deviation(*variance, epsilon)) as f32
    };
    gamma.iter().zip(variance).map(scale).collect()
}

/// How a map is cut.
#[derive(Clone, Copy)]
struct Rows {
    /// Values of a row: whole pixels.
    width: usize,
    /// Values of a block: whole rows.
    block: usize,
}

impl Rows {
    fn new(len: usize, channels: usize) -> Self {
        let pixels = ROW.div_ceil(channels);
        // Short pixels that fill no vectors do so 16 at a time.
        let odd = channels < ROW / 4 && !channels.is_multiple_of(16);
        let pixels = if odd {
            pixels.next_multiple_of(16)
        } else {
            pixels
        };
        // One row is enough for a map that is shorter.
        let width = (channels * pixels).min(len);
        Rows {
            width,
            block: width * (BLOCK / width).max(1),
        }
    }

    /// A parameter by channel, for each value of a row.
    fn repeated(self, parameter: &[f32]) -> Vec<f32> {
        parameter.iter().copied().cycle().take(self.width).collect()
    }
}

/// Mean and biased variance of each channel.
fn statistics(isa: Isa, x: &[f32], mean: &mut [f32], variance: &mut [f32]) {
    let channels = mean.len();
    let rows = Rows::new(x.len(), channels);
    let blocks = tasks::map(x.chunks(rows.block), |x| {
        // SAFETY: the leaf has slices only.
        unsafe {
            simd::run(
                tasks::streaming(isa),
                Moments {
                    x,
                    width: rows.width,
                    channels,
                },
            )
        }
    });
    // Combined as by Chan, Golub and LeVeque (1983): no difference of large sums.
    let pixels = (x.len() / channels) as f64;
    let counts = || x.chunks(rows.block).map(|x| (x.len() / channels) as f64);
    for c in 0..channels {
        let sum: f64 = blocks
            .iter()
            .zip(counts())
            .map(|(block, count)| block[c][0] * count)
            .sum();
        let center = sum / pixels;
        let squares = blocks.iter().zip(counts()).map(|(block, count)| {
            block[c][1] + count * (block[c][0] - center) * (block[c][0] - center)
        });
        mean[c] = center as f32;
        variance[c] = (squares.sum::<f64>() / pixels) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_within, bits, pattern, same_on_any_number_of_threads};

    const EPSILON: f32 = 1e-3;

    /// Pixels and channels: one value, vectors left unfilled, several blocks, a block with a part of a row.
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

    /// Channels of different means, spreads and weights.
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

    struct Found {
        y: Vec<f32>,
        mean: Vec<f32>,
        variance: Vec<f32>,
        dx: Vec<f32>,
        dgamma: Vec<f32>,
        dbeta: Vec<f32>,
    }

    fn found(isa: Isa, case: &Case, relu: bool) -> Found {
        let (len, channels) = (case.x.len(), case.gamma.len());
        let map = || vec![f32::NAN; len];
        let row = || vec![f32::NAN; channels];
        let (mut y, mut mean, mut variance) = (map(), row(), row());
        forward_train(
            isa,
            &case.x,
            &case.gamma,
            &case.beta,
            EPSILON,
            relu,
            &mut y,
            &mut mean,
            &mut variance,
        );
        let (mut dx, mut dgamma, mut dbeta) = (map(), row(), row());
        let gate = relu.then_some(&y[..]);
        backward(
            isa,
            &case.x,
            &case.gamma,
            &mean,
            &variance,
            EPSILON,
            gate,
            &case.dy,
            &mut dx,
            &mut dgamma,
            &mut dbeta,
        );
        Found {
            y,
            mean,
            variance,
            dx,
            dgamma,
            dbeta,
        }
    }

    /// Compares with plain loops in float64. Gates are those of the float32 output, which a value near 0 may flip.
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
        // Means to a rounding of values up to 5; s is up to 32, where one pixel has no spread.
        assert_within(&format!("mean, {what}"), &found.mean, &means, 2e-7);
        assert_within(
            &format!("variance, {what}"),
            &found.variance,
            &variances,
            2e-7,
        );
        assert_within(&format!("y, {what}"), &found.y, &y, 5e-6);
        // Sums of up to 5000 terms of order 1, of which float32 adds some tens to a few hundred.
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

    /// A mean of a thousand deviations, drifting over the map, and a first pixel far off.
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
                &[2.0; 3],
                &beta,
                EPSILON,
                false,
                &mut y,
                &mut mean,
                &mut variance,
            );
            assert_eq!((mean, variance), ([0.3; 3], [0.0; 3]));
            assert!(y.iter().enumerate().all(|(i, y)| *y == beta[i % 3]));
        }
    }

    /// No fused operations: the same everywhere.
    #[test]
    #[cfg_attr(miri, ignore = "minutes long")]
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
    fn what_is_no_number_reaches_the_output_through_the_relu() {
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
            forward_eval(
                isa, &x, &[1.0; 3], &[0.0; 3], &[0.0; 3], &[1.0; 3], 0.0, true, &mut y,
            );
            assert!(
                y[0] == f32::INFINITY && y[1].is_nan() && y[2] == 0.0,
                "{isa}: {y:?}"
            );
        }
    }

    #[test]
    #[should_panic(expected = "10 values are no map of 3 channels")]
    fn lengths_are_checked() {
        forward_eval(
            Isa::Portable,
            &[0.0; 10],
            &[0.0; 3],
            &[0.0; 3],
            &[0.0; 3],
            &[0.0; 3],
            0.0,
            true,
            &mut [0.0; 10],
        );
    }
}
