//! Batch normalisation (Ioffe and Szegedy 2015) with the ReLU after it.
//!
//! Channels come last, so a per-channel parameter is repeated to the length of a *row* of pixels.
//! Passes are then plain loops over rows, which the compiler vectorises for any number of channels.
//! Sums run along the columns of such rows, in float32 within a *block* of fixed size. Blocks are
//! added in float64, in order.
//!
//! NaN and infinite values reach the output: ReLU lets NaN through.

mod passes;

use passes::{BlockMoments, GradientSums, InputGradient, Normalize};

use crate::Isa;
use crate::simd;
use crate::tasks::{self, TASK};

/// Minimum number of values in a row.
const ROW: usize = 512;

/// Approximate number of values in a block: 128 KiB, which stays in a core's own cache for the
/// second pass.
const BLOCK: usize = 2 * TASK;

/// A batch normalisation and the ReLU after it.
///
/// # Shapes
/// `[channels]`.
#[derive(Clone, Copy, Debug)]
pub struct BatchNorm<'a> {
    /// Scale.
    pub gamma: &'a [f32],
    /// Shift.
    pub beta: &'a [f32],
    /// Added to the variance.
    pub epsilon: f32,
    /// Whether the output is rectified.
    pub relu: bool,
}

/// Mean and biased variance over all pixels.
///
/// # Shapes
/// `[channels]`.
#[derive(Clone, Copy, Debug)]
pub struct Moments<T> {
    /// Mean.
    pub mean: T,
    /// Biased variance.
    pub variance: T,
}

/// Normalises by the statistics of the batch: `y = (x - mean) / sqrt(variance + epsilon) * gamma +
/// beta`, rectified if `norm.relu`. Writes the statistics to `moments`.
///
/// # Shapes
/// `x` and `y`: `[pixels, channels]`.
///
/// # Panics
/// If a length does not match the others, or a map has no pixels.
pub fn forward_train(
    isa: Isa,
    x: &[f32],
    norm: BatchNorm,
    y: &mut [f32],
    moments: Moments<&mut [f32]>,
) {
    let BatchNorm { gamma, beta, .. } = norm;
    let Moments { mean, variance } = moments;
    check(
        x.len(),
        gamma.len(),
        &[beta.len(), mean.len(), variance.len()],
    );
    statistics(isa, x, mean, variance);
    forward_eval(isa, x, norm, Moments { mean, variance }, y);
}

/// Normalises by given statistics: `y = (x - mean) / sqrt(variance + epsilon) * gamma + beta`,
/// rectified if `norm.relu`.
///
/// # Shapes
/// `x` and `y`: `[pixels, channels]`.
///
/// # Panics
/// If a length does not match the others, or a map has no pixels.
pub fn forward_eval(isa: Isa, x: &[f32], norm: BatchNorm, moments: Moments<&[f32]>, y: &mut [f32]) {
    let BatchNorm {
        gamma,
        beta,
        epsilon,
        relu,
    } = norm;
    let Moments { mean, variance } = moments;
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
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });
}

/// What the gradients of [`forward_train`] are computed from.
///
/// # Shapes
/// `x`, `y`, and `dy`: `[pixels, channels]`; the others `[channels]`.
#[derive(Clone, Copy, Debug)]
pub struct BatchNormSource<'a> {
    /// Input.
    pub x: &'a [f32],
    /// Scale.
    pub gamma: &'a [f32],
    /// Statistics of `x`.
    pub moments: Moments<&'a [f32]>,
    /// Added to the variance.
    pub epsilon: f32,
    /// The output, if it was rectified: `dy` counts only where it is positive.
    pub y: Option<&'a [f32]>,
    /// Gradient with respect to the output.
    pub dy: &'a [f32],
}

/// Gradients of [`forward_train`], including the dependence of its statistics on `x`. All three are
/// overwritten.
///
/// # Shapes
/// `dx`: `[pixels, channels]`; `dgamma` and `dbeta`: `[channels]`.
///
/// # Panics
/// If a length does not match the others, or a map has no pixels.
pub fn backward(
    isa: Isa,
    source: BatchNormSource,
    dx: &mut [f32],
    dgamma: &mut [f32],
    dbeta: &mut [f32],
) {
    let BatchNormSource {
        x,
        gamma,
        moments: Moments { mean, variance },
        epsilon,
        y,
        dy,
    } = source;
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
    // Without a ReLU the value of `y` does not matter.
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
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });

    let found = ChannelGradients::new(x.len() / channels, gamma, variance, epsilon, &sums);
    dgamma.copy_from_slice(&found.dgamma);
    dbeta.copy_from_slice(&found.dbeta);
    let [scale, slope, shift] =
        [&found.scale, &found.slope, &found.shift].map(|values| rows.repeated(values));
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
            // SAFETY: the leaf accesses memory through slices only.
            unsafe { simd::run(tasks::streaming(isa), leaf) }
        },
    );
}

/// What sums over all pixels determine, for each channel. Let g be dy behind the gate, n the pixels,
/// and s = 1 / sqrt(variance + epsilon). Then
///
/// dbeta = sum g, dgamma = s sum g (x - mean),
///
/// dx = gamma s (g - dbeta / n - (x - mean) s dgamma / n) = scale g + shift + slope (x - mean).
struct ChannelGradients {
    dgamma: Vec<f32>,
    dbeta: Vec<f32>,
    scale: Vec<f32>,
    slope: Vec<f32>,
    shift: Vec<f32>,
}

impl ChannelGradients {
    /// From the sums of g and of g (x - mean) over each block.
    fn new(
        pixels: usize,
        gamma: &[f32],
        variance: &[f32],
        epsilon: f32,
        blocks: &[Vec<[f64; 2]>],
    ) -> Self {
        let pixels = pixels as f64;
        let zeros = || vec![0.0; gamma.len()];
        let mut found = ChannelGradients {
            dgamma: zeros(),
            dbeta: zeros(),
            scale: scales(gamma, variance, epsilon),
            slope: zeros(),
            shift: zeros(),
        };
        for c in 0..gamma.len() {
            let [plain, by_x] = blocks.iter().fold([0.0; 2], |sum, block| {
                [sum[0] + block[c][0], sum[1] + block[c][1]]
            });
            let s = inverse_deviation(variance[c], epsilon);
            let scale = f64::from(found.scale[c]);
            found.dbeta[c] = plain as f32;
            found.dgamma[c] = (s * by_x) as f32;
            found.slope[c] = (-scale * s * s * by_x / pixels) as f32;
            found.shift[c] = (-scale * plain / pixels) as f32;
        }
        found
    }
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

/// How a map is divided into rows and blocks.
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
        // Pixels too short to fill vectors are processed 16 at a time.
        let odd = channels < ROW / 4 && !channels.is_multiple_of(16);
        let pixels = if odd {
            pixels.next_multiple_of(16)
        } else {
            pixels
        };
        // A map shorter than that is one row.
        let width = (channels * pixels).min(len);
        Rows {
            width,
            block: width * (BLOCK / width).max(1),
        }
    }

    /// A per-channel parameter, repeated for each value of a row.
    fn repeated(self, parameter: &[f32]) -> Vec<f32> {
        parameter.iter().copied().cycle().take(self.width).collect()
    }
}

fn statistics(isa: Isa, x: &[f32], mean: &mut [f32], variance: &mut [f32]) {
    let channels = mean.len();
    let rows = Rows::new(x.len(), channels);
    let blocks = tasks::map(x.chunks(rows.block), |x| {
        // SAFETY: the leaf accesses memory through slices only.
        unsafe {
            simd::run(
                tasks::streaming(isa),
                BlockMoments {
                    x,
                    width: rows.width,
                    channels,
                },
            )
        }
    });
    // Combined as in Chan, Golub and LeVeque (1983), without differences of large sums.
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
mod tests;
