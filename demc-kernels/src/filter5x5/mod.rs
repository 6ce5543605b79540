//! Filtering with one 5x5 kernel per pixel (kernel prediction, Bako et al. 2017), and the blend of
//! two scales (Vogels et al. 2018).
//!
//! Both are linear in the image. No operation is fused, so the bits are the same on every path.

#[cfg(test)]
mod tests;

use std::ops::Range;

use crate::power::{exp, sigmoid};
use crate::scratch::Scratch;
use crate::simd::{self, Leaf, Simd};
use crate::tasks;
use crate::{Grid, Isa};

/// Channels of the filtered image.
pub const COLORS: usize = 3;
/// Side of a kernel, in pixels.
const SIDE: usize = 5;
/// Pixels on each side of the centre.
const REACH: usize = SIDE / 2;
/// Weights of a kernel.
pub const TAPS: usize = SIDE * SIDE;
/// Channels of a padded pixel: a vector of four lanes.
const LANES: usize = 4;
/// The taps in whole vectors.
const PADDED_TAPS: usize = 32;

/// Filters each pixel with its own 5x5 kernel: the softmax of its first 25 logits. The image's
/// border is replicated. A 26th logit becomes a fourth channel, its sigmoid.
///
/// # Shapes
/// On `grid`: image `x` of 3 channels, `logits` of 25 or 26, `y` of 3 or 4.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, x: &[f32], logits: &[f32], y: &mut [f32]) {
    let shape = Shape::of(grid, x.len(), logits.len());
    assert_eq!(
        y.len(),
        grid.pixels() * shape.outputs,
        "the output on {grid:?}"
    );
    let pixels = grid.height * grid.width;
    let images = x
        .chunks(pixels * COLORS)
        .zip(logits.chunks(pixels * shape.logits))
        .zip(y.chunks_mut(pixels * shape.outputs));
    for ((x, logits), y) in images {
        forward_rows(isa, grid, x, 0..grid.height, logits, y);
    }
}

/// The same for some rows of one image.
///
/// # Shapes
/// Image `x` on `grid` with batch 1; `logits` and `y` have the rows alone.
///
/// # Panics
/// If a length does not match the others.
pub fn forward_rows(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    rows: Range<usize>,
    logits: &[f32],
    y: &mut [f32],
) {
    let grid = Grid { batch: 1, ..grid };
    let band = Grid {
        height: rows.len(),
        ..grid
    };
    let shape = Shape {
        width: grid.width,
        ..Shape::of(band, band.pixels() * COLORS, logits.len())
    };
    assert_eq!(x.len(), grid.pixels() * COLORS, "the image on {grid:?}");
    let (row, out_row) = (grid.width * shape.logits, grid.width * shape.outputs);
    let step = tasks::rows_per_task(row);
    let starts = rows.clone().step_by(step);
    let pieces = starts.zip(logits.chunks(step * row).zip(y.chunks_mut(step * out_row)));
    tasks::each(pieces, |(start, (logits, y))| {
        let image = padded(grid, x, start..start + logits.len() / row);
        let leaf = Forward {
            shape,
            image: &image,
            logits,
            y,
        };
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });
}

/// The gradient of [`forward`] with respect to the logits.
///
/// # Shapes
/// As for `forward`; `dy` has the shape of `y`, `dlogits` that of `logits`.
///
/// # Panics
/// If a length does not match the others.
pub fn backward(isa: Isa, grid: Grid, x: &[f32], logits: &[f32], dy: &[f32], dlogits: &mut [f32]) {
    let shape = Shape::of(grid, x.len(), logits.len());
    assert_eq!(
        dy.len(),
        grid.pixels() * shape.outputs,
        "the gradient on {grid:?}"
    );
    assert_eq!(dlogits.len(), logits.len(), "logits and their gradient");
    let pixels = grid.height * grid.width;
    let (row, out_row) = (grid.width * shape.logits, grid.width * shape.outputs);
    let step = tasks::rows_per_task(row);
    let single = Grid { batch: 1, ..grid };
    let images = x
        .chunks(pixels * COLORS)
        .zip(logits.chunks(pixels * shape.logits))
        .zip(dy.chunks(pixels * shape.outputs))
        .zip(dlogits.chunks_mut(pixels * shape.logits));
    let pieces = images.flat_map(|(((x, logits), dy), dlogits)| {
        let bands = logits.chunks(step * row).zip(dy.chunks(step * out_row));
        let bands = bands.zip(dlogits.chunks_mut(step * row)).enumerate();
        bands.map(move |(piece, ((logits, dy), dlogits))| (x, piece * step, logits, dy, dlogits))
    });
    tasks::each(pieces, |(x, start, logits, dy, dlogits)| {
        let image = padded(single, x, start..start + logits.len() / row);
        let leaf = Backward {
            shape,
            image: &image,
            logits,
            dy,
            dlogits,
        };
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });
}

#[derive(Clone, Copy)]
struct Shape {
    width: usize,
    logits: usize,
    outputs: usize,
}

impl Shape {
    #[track_caller]
    fn of(grid: Grid, image: usize, logits: usize) -> Self {
        assert_eq!(
            grid.channels(image),
            COLORS,
            "channels of the image on {grid:?}"
        );
        let logits = grid.channels(logits);
        assert!(
            (TAPS..=TAPS + 1).contains(&logits),
            "{logits} logits per pixel"
        );
        Shape {
            width: grid.width,
            logits,
            outputs: COLORS + logits - TAPS,
        }
    }
}

/// Some rows of an image with two more pixels on each side, and four channels, the last one 0.
fn padded(grid: Grid, x: &[f32], rows: Range<usize>) -> Scratch {
    let width = grid.width + 2 * REACH;
    let mut image = Scratch::take((rows.len() + 2 * REACH) * width * LANES);
    for (line, target) in image.chunks_exact_mut(width * LANES).enumerate() {
        let row = (rows.start + line)
            .saturating_sub(REACH)
            .min(grid.height - 1);
        let source = &x[row * grid.width * COLORS..(row + 1) * grid.width * COLORS];
        for (column, target) in target.chunks_exact_mut(LANES).enumerate() {
            let column = column.saturating_sub(REACH).min(grid.width - 1);
            target[..COLORS].copy_from_slice(&source[column * COLORS..(column + 1) * COLORS]);
            target[COLORS] = 0.0;
        }
    }
    image
}

/// The softmax of 25 logits; the rest is 0.
#[inline(always)]
fn kernel_of(logits: &[f32]) -> [f32; PADDED_TAPS] {
    let mut kernel = [f32::NEG_INFINITY; PADDED_TAPS];
    kernel[..TAPS].copy_from_slice(&logits[..TAPS]);
    let largest = kernel
        .iter()
        .fold(f32::NEG_INFINITY, |a, b| if *b > a { *b } else { a });
    for weight in &mut kernel {
        *weight = exp(*weight - largest);
    }
    let mut sums = [0.0; 8];
    for part in kernel.chunks_exact(8) {
        for (sum, weight) in sums.iter_mut().zip(part) {
            *sum += weight;
        }
    }
    let inverse = 1.0 / sums.iter().sum::<f32>();
    for weight in &mut kernel {
        *weight *= inverse;
    }
    kernel
}

struct Forward<'a> {
    shape: Shape,
    image: &'a [f32],
    logits: &'a [f32],
    y: &'a mut [f32],
}

impl Leaf for Forward<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Shape {
            width,
            logits,
            outputs,
        } = self.shape;
        let pixels = self
            .logits
            .chunks_exact(logits)
            .zip(self.y.chunks_exact_mut(outputs));
        for (pixel, (logits, y)) in pixels.enumerate() {
            let kernel = kernel_of(logits);
            let mut sum = [0.0; LANES];
            for (line, weights) in kernel[..TAPS].chunks_exact(SIDE).enumerate() {
                let taps = window(self.image, width, pixel, line);
                for (tap, weight) in taps.chunks_exact(LANES).zip(weights) {
                    for (sum, value) in sum.iter_mut().zip(tap) {
                        *sum += weight * value;
                    }
                }
            }
            y[..COLORS].copy_from_slice(&sum[..COLORS]);
            if let [blend] = &mut y[COLORS..] {
                *blend = sigmoid(logits[TAPS]);
            }
        }
    }
}

struct Backward<'a> {
    shape: Shape,
    image: &'a [f32],
    logits: &'a [f32],
    dy: &'a [f32],
    dlogits: &'a mut [f32],
}

impl Leaf for Backward<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Shape {
            width,
            logits,
            outputs,
        } = self.shape;
        let pixels = self
            .logits
            .chunks_exact(logits)
            .zip(self.dy.chunks_exact(outputs));
        let pixels = pixels.zip(self.dlogits.chunks_exact_mut(logits));
        for (pixel, ((logits, dy), dlogits)) in pixels.enumerate() {
            let kernel = kernel_of(logits);
            let mut slopes = [0.0; PADDED_TAPS];
            for (line, slopes) in slopes[..TAPS].chunks_exact_mut(SIDE).enumerate() {
                let taps = window(self.image, width, pixel, line);
                for (tap, slope) in taps.chunks_exact(LANES).zip(slopes) {
                    *slope = dy[0] * tap[0] + dy[1] * tap[1] + dy[2] * tap[2];
                }
            }
            let mean = kernel
                .iter()
                .zip(&slopes)
                .fold(0.0, |sum, (k, s)| sum + k * s);
            let weights = kernel.iter().zip(&slopes);
            for (dlogit, (weight, slope)) in dlogits[..TAPS].iter_mut().zip(weights) {
                *dlogit = weight * (slope - mean);
            }
            if let [dblend] = &mut dlogits[TAPS..] {
                let blend = sigmoid(logits[TAPS]);
                *dblend = dy[COLORS] * blend * (1.0 - blend);
            }
        }
    }
}

/// Five neighbours of a pixel in a padded image: row `line` of its window.
#[inline(always)]
fn window(image: &[f32], width: usize, pixel: usize, line: usize) -> &[f32] {
    let (y, x) = (pixel / width, pixel % width);
    let first = ((y + line) * (width + 2 * REACH) + x) * LANES;
    &image[first..first + SIDE * LANES]
}
