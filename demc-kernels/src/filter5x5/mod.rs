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
/// Pixels of a row that are computed together, one per lane.
const BLOCK: usize = 16;

/// One value for each pixel of a block.
type Lanes = [f32; BLOCK];

/// Filters each pixel with its own 5x5 kernel: the softmax of its first 25 logits. The image's
/// border is replicated. A 26th logit becomes a fourth channel, its sigmoid.
///
/// Several images may share kernels: the layers of a rendering. Their kernels are computed once.
///
/// # Shapes
/// `logits` of 25 or 26 channels on `grid`. Image `x` of 3 channels and `y` of 3 or 4 have `n` images
/// for each one of `grid`; these `n` are adjacent.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, x: &[f32], logits: &[f32], y: &mut [f32]) {
    let shape = Shape::of(grid, logits.len());
    let (pixels, sharing) = (grid.height * grid.width, shape.sharing(grid, x.len()));
    assert_eq!(
        y.len(),
        sharing * grid.pixels() * shape.outputs,
        "the output on {grid:?}"
    );
    let grid = Grid {
        batch: sharing,
        ..grid
    };
    let images = x
        .chunks(sharing * pixels * COLORS)
        .zip(logits.chunks(pixels * shape.logits))
        .zip(y.chunks_mut(sharing * pixels * shape.outputs));
    for ((x, logits), y) in images {
        let y = y.chunks_mut(pixels * shape.outputs).collect();
        forward_rows(isa, grid, x, 0..grid.height, logits, y);
    }
}

/// The same for some rows of images that share kernels.
///
/// # Shapes
/// Images `x` on `grid`. `logits`, and `y` for each image, have the rows alone.
///
/// # Panics
/// If a length does not match the others.
pub fn forward_rows(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    rows: Range<usize>,
    logits: &[f32],
    y: Vec<&mut [f32]>,
) {
    let band = Grid {
        batch: 1,
        height: rows.len(),
        ..grid
    };
    let shape = Shape::of(band, logits.len());
    assert_eq!(x.len(), grid.pixels() * COLORS, "the images on {grid:?}");
    assert_eq!(y.len(), grid.batch, "an output for each image");
    let values = band.pixels() * shape.outputs;
    assert!(
        y.iter().all(|y| y.len() == values),
        "the outputs on {band:?}"
    );
    let (row, out_row) = (grid.width * shape.logits, grid.width * shape.outputs);
    let step = tasks::rows_per_task(row);
    let starts = rows.step_by(step);
    let mut outputs: Vec<_> = y
        .into_iter()
        .map(|y| y.chunks_mut(step * out_row))
        .collect();
    let pieces = starts
        .zip(logits.chunks(step * row))
        .map(|(start, logits)| {
            let y: Vec<&mut [f32]> = outputs.iter_mut().filter_map(Iterator::next).collect();
            (start, logits, y)
        });
    let single = Grid { batch: 1, ..grid };
    tasks::each(pieces, |(start, logits, y)| {
        let rows = start..start + logits.len() / row;
        let images = x.chunks(single.pixels() * COLORS);
        let images: Vec<PaddedRows> = images
            .map(|x| PaddedRows::new(single, x, rows.clone()))
            .collect();
        let leaf = Forward {
            shape,
            images: &images,
            logits,
            y,
        };
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(isa, leaf) }
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
    let shape = Shape::of(grid, logits.len());
    assert_eq!(
        grid.channels(x.len()),
        COLORS,
        "channels of the image on {grid:?}"
    );
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
        let image = PaddedRows::new(single, x, start..start + logits.len() / row);
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
    fn of(grid: Grid, logits: usize) -> Self {
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

    /// The number of images that share kernels, from the number of values of all images.
    #[track_caller]
    fn sharing(self, grid: Grid, image: usize) -> usize {
        let channels = grid.channels(image);
        assert!(
            channels > 0 && channels.is_multiple_of(COLORS),
            "{channels} channels of images on {grid:?}"
        );
        channels / COLORS
    }
}

/// Some rows of an image with two more pixels on each side, each row as three planes. Blocks may
/// read beyond the row.
struct PaddedRows {
    values: Scratch,
    /// Values of a plane of a row.
    stride: usize,
}

impl PaddedRows {
    fn new(grid: Grid, x: &[f32], rows: Range<usize>) -> Self {
        let stride = grid.width.next_multiple_of(BLOCK) + 2 * REACH;
        let mut values = Scratch::take((rows.len() + 2 * REACH) * COLORS * stride);
        for (line, planes) in values.chunks_exact_mut(COLORS * stride).enumerate() {
            let row = (rows.start + line)
                .saturating_sub(REACH)
                .min(grid.height - 1);
            let source = &x[row * grid.width * COLORS..(row + 1) * grid.width * COLORS];
            let (first, last) = (&source[..COLORS], &source[source.len() - COLORS..]);
            for (color, plane) in planes.chunks_exact_mut(stride).enumerate() {
                let (before, rest) = plane.split_at_mut(REACH);
                let (own, after) = rest.split_at_mut(grid.width);
                before.fill(first[color]);
                after.fill(last[color]);
                let source = source[color..].iter().step_by(COLORS);
                own.iter_mut()
                    .zip(source)
                    .for_each(|(to, from)| *to = *from);
            }
        }
        PaddedRows { values, stride }
    }

    /// A colour of the pixels from (`line`, `column`) on, counted from the padding's corner.
    #[inline(always)]
    fn lanes(&self, line: usize, color: usize, column: usize) -> &Lanes {
        let first = (line * COLORS + color) * self.stride + column;
        let lanes = self.values[first..first + BLOCK].try_into();
        lanes.expect("a block's length")
    }
}

/// The kernels of the pixels of a block: the softmax of their first 25 logits, tap by tap.
#[inline(always)]
fn kernels_of(logits: &[f32], channels: usize) -> [Lanes; TAPS] {
    let mut kernels = [[0.0; BLOCK]; TAPS];
    for (pixel, logits) in logits.chunks_exact(channels).enumerate() {
        for (tap, logit) in kernels.iter_mut().zip(logits) {
            tap[pixel] = *logit;
        }
    }
    let mut largest = [f32::NEG_INFINITY; BLOCK];
    for tap in &kernels {
        for (largest, logit) in largest.iter_mut().zip(tap) {
            *largest = if *logit > *largest { *logit } else { *largest };
        }
    }
    let mut sum = [0.0; BLOCK];
    for tap in &mut kernels {
        for ((weight, largest), sum) in tap.iter_mut().zip(&largest).zip(&mut sum) {
            *weight = exp(*weight - largest);
            *sum += *weight;
        }
    }
    let inverse = sum.map(|sum| 1.0 / sum);
    for tap in &mut kernels {
        for (weight, inverse) in tap.iter_mut().zip(&inverse) {
            *weight *= inverse;
        }
    }
    kernels
}

/// The blend weights of the pixels of a block: the sigmoid of their 26th logits.
#[inline(always)]
fn blends_of(logits: &[f32], channels: usize) -> Lanes {
    let mut blends = [0.0; BLOCK];
    if channels > TAPS {
        let logits = logits.chunks_exact(channels);
        for (blend, logits) in blends.iter_mut().zip(logits) {
            *blend = logits[TAPS];
        }
        for blend in &mut blends {
            *blend = sigmoid(*blend);
        }
    }
    blends
}

struct Forward<'a> {
    shape: Shape,
    images: &'a [PaddedRows],
    logits: &'a [f32],
    /// An output for each image.
    y: Vec<&'a mut [f32]>,
}

impl Leaf for Forward<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(mut self) {
        let Shape {
            width,
            logits: channels,
            outputs,
        } = self.shape;
        for (row, logits) in self.logits.chunks_exact(width * channels).enumerate() {
            for (block, logits) in logits.chunks(BLOCK * channels).enumerate() {
                let kernels = kernels_of(logits, channels);
                let blends = blends_of(logits, channels);
                let first = (row * width + block * BLOCK) * outputs;
                let values = logits.len() / channels * outputs;
                for (image, y) in self.images.iter().zip(&mut self.y) {
                    let mut colors = [[0.0; BLOCK]; COLORS];
                    for first in (0..BLOCK).step_by(S::LANES) {
                        // SAFETY: all blocks hold whole vectors from `first` on.
                        unsafe {
                            let mut sums = [S::zero(); COLORS];
                            for (tap, weights) in kernels.iter().enumerate() {
                                let weight = S::load(weights[first..].as_ptr());
                                let (line, column) = (row + tap / SIDE, block * BLOCK + tap % SIDE);
                                for (color, sum) in sums.iter_mut().enumerate() {
                                    let values = image.lanes(line, color, column);
                                    let value = S::load(values[first..].as_ptr());
                                    *sum = S::add(*sum, S::mul(weight, value));
                                }
                            }
                            for (color, sum) in colors.iter_mut().zip(sums) {
                                S::store(color[first..].as_mut_ptr(), sum);
                            }
                        }
                    }
                    let y = &mut y[first..first + values];
                    for (pixel, y) in y.chunks_exact_mut(outputs).enumerate() {
                        for (y, lanes) in y.iter_mut().zip(colors.iter().chain([&blends])) {
                            *y = lanes[pixel];
                        }
                    }
                }
            }
        }
    }
}

struct Backward<'a> {
    shape: Shape,
    image: &'a PaddedRows,
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
            logits: channels,
            outputs,
        } = self.shape;
        let rows = (self.logits.chunks_exact(width * channels))
            .zip(self.dy.chunks_exact(width * outputs))
            .zip(self.dlogits.chunks_exact_mut(width * channels));
        for (row, ((logits, dy), dlogits)) in rows.enumerate() {
            let blocks = (logits.chunks(BLOCK * channels))
                .zip(dy.chunks(BLOCK * outputs))
                .zip(dlogits.chunks_mut(BLOCK * channels));
            for (block, ((logits, dy), dlogits)) in blocks.enumerate() {
                let kernels = kernels_of(logits, channels);
                let mut dcolors = [[0.0; BLOCK]; COLORS];
                for (pixel, dy) in dy.chunks_exact(outputs).enumerate() {
                    for (color, dy) in dcolors.iter_mut().zip(dy) {
                        color[pixel] = *dy;
                    }
                }
                let blends = blends_of(logits, channels);
                let mut slopes = [[0.0; BLOCK]; TAPS];
                for first in (0..BLOCK).step_by(S::LANES) {
                    // SAFETY: all blocks hold whole vectors from `first` on.
                    unsafe {
                        let dcolors =
                            [0, 1, 2].map(|color| S::load(dcolors[color][first..].as_ptr()));
                        let mut mean = S::zero();
                        for (tap, (slopes, weights)) in slopes.iter_mut().zip(&kernels).enumerate()
                        {
                            let (line, column) = (row + tap / SIDE, block * BLOCK + tap % SIDE);
                            let mut slope = S::zero();
                            for (color, dcolor) in dcolors.into_iter().enumerate() {
                                let values = self.image.lanes(line, color, column);
                                let value = S::load(values[first..].as_ptr());
                                slope = S::add(slope, S::mul(dcolor, value));
                            }
                            let weight = S::load(weights[first..].as_ptr());
                            mean = S::add(mean, S::mul(weight, slope));
                            S::store(slopes[first..].as_mut_ptr(), slope);
                        }
                        for (slopes, weights) in slopes.iter_mut().zip(&kernels) {
                            let weight = S::load(weights[first..].as_ptr());
                            let slope = S::load(slopes[first..].as_ptr());
                            let dlogit = S::mul(weight, S::sub(slope, mean));
                            S::store(slopes[first..].as_mut_ptr(), dlogit);
                        }
                    }
                }
                let pixels = dy
                    .chunks_exact(outputs)
                    .zip(dlogits.chunks_exact_mut(channels));
                for (pixel, (dy, dlogits)) in pixels.enumerate() {
                    for (dlogit, slopes) in dlogits.iter_mut().zip(&slopes) {
                        *dlogit = slopes[pixel];
                    }
                    if let [dblend] = &mut dlogits[TAPS..] {
                        let blend = blends[pixel];
                        *dblend = dy[COLORS] * blend * (1.0 - blend);
                    }
                }
            }
        }
    }
}
