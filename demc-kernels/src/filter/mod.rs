//! Filtering with one kernel per pixel, 5x5 or 21x21 (kernel prediction, Bako et al. 2017).
//!
//! It is linear in the image. No operation is fused, so the bits are the same on every path.

mod block;
#[cfg(test)]
mod tests;

use std::ops::Range;

use crate::simd::{self, Leaf, Simd};
use crate::tasks;
use crate::{Grid, Isa};
use block::{BLOCK, PaddedRows, blends_of, kernels_of};

pub use block::COLORS;

/// Sides of the kernels, in pixels.
const SIDES: [usize; 2] = [5, 21];

/// Channels of the output, with these logits of a kernel: 3, or 4 with a blend weight.
///
/// # Panics
/// If no kernel has this number of logits.
#[track_caller]
pub fn outputs(logits: usize) -> usize {
    COLORS + logits - side_of(logits).pow(2)
}

/// The side of the kernel with this number of logits.
#[track_caller]
fn side_of(logits: usize) -> usize {
    let side = SIDES
        .into_iter()
        .find(|side| (side * side..=side * side + 1).contains(&logits));
    side.unwrap_or_else(|| panic!("{logits} logits per pixel"))
}

/// Images, and the logits of the kernels that filter them.
#[derive(Clone, Copy, Debug)]
pub struct Filter<'a> {
    /// Images.
    pub x: &'a [f32],
    /// Logits.
    pub logits: &'a [f32],
}

/// Filters each pixel with its own kernel, 5x5 or 21x21: the softmax of its first 25 or 441 logits.
/// The image's border is replicated. One more logit becomes a fourth channel, its sigmoid.
///
/// Several images may share kernels: the layers of a rendering. Their kernels are computed once.
///
/// # Shapes
/// `logits` of 25, 26, 441, or 442 channels on `grid`. Image `x` of 3 channels and `y` of 3 or 4 have `n` images
/// for each one of `grid`; these `n` are adjacent.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, filter: Filter, y: &mut [f32]) {
    let Filter { x, logits } = filter;
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
        forward_rows(isa, grid, Filter { x, logits }, 0..grid.height, y);
    }
}

/// The same for some rows of images that share kernels.
///
/// # Shapes
/// Images `x` on `grid`. `logits`, and `y` for each image, have the rows alone.
///
/// # Panics
/// If a length does not match the others.
pub fn forward_rows(isa: Isa, grid: Grid, filter: Filter, rows: Range<usize>, y: Vec<&mut [f32]>) {
    let Filter { x, logits } = filter;
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
        let images: Vec<PaddedRows> = x
            .chunks(single.pixels() * COLORS)
            .map(|x| PaddedRows::new(single, x, rows.clone(), shape.side))
            .collect();
        let images = &images;
        // SAFETY: the leaf accesses memory through slices only.
        unsafe {
            match shape.side {
                5 => simd::run(
                    isa,
                    Forward::<5, 25> {
                        shape,
                        images,
                        logits,
                        y,
                    },
                ),
                _ => simd::run(
                    isa,
                    Forward::<21, 441> {
                        shape,
                        images,
                        logits,
                        y,
                    },
                ),
            }
        }
    });
}

/// The gradient of [`forward`] with respect to the logits.
///
/// # Shapes
/// As for `forward`; `dy` has the shape of `y`, `dlogits` that of `logits`.
///
/// # Panics
/// If a length does not match the others.
pub fn backward(isa: Isa, grid: Grid, filter: Filter, dy: &[f32], dlogits: &mut [f32]) {
    let Filter { x, logits } = filter;
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
        let bands = logits
            .chunks(step * row)
            .zip(dy.chunks(step * out_row))
            .zip(dlogits.chunks_mut(step * row))
            .enumerate();
        bands.map(move |(piece, ((logits, dy), dlogits))| (x, piece * step, logits, dy, dlogits))
    });
    tasks::each(pieces, |(x, start, logits, dy, dlogits)| {
        let rows = start..start + logits.len() / row;
        let image = &PaddedRows::new(single, x, rows, shape.side);
        let isa = tasks::streaming(isa);
        // SAFETY: the leaf accesses memory through slices only.
        unsafe {
            match shape.side {
                5 => simd::run(
                    isa,
                    Backward::<5, 25> {
                        shape,
                        image,
                        logits,
                        dy,
                        dlogits,
                    },
                ),
                _ => simd::run(
                    isa,
                    Backward::<21, 441> {
                        shape,
                        image,
                        logits,
                        dy,
                        dlogits,
                    },
                ),
            }
        }
    });
}

#[derive(Clone, Copy)]
struct Shape {
    width: usize,
    side: usize,
    logits: usize,
    outputs: usize,
}

impl Shape {
    #[track_caller]
    fn of(grid: Grid, logits: usize) -> Self {
        let logits = grid.channels(logits);
        Shape {
            width: grid.width,
            side: side_of(logits),
            logits,
            outputs: outputs(logits),
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

struct Forward<'a, const SIDE: usize, const TAPS: usize> {
    shape: Shape,
    images: &'a [PaddedRows],
    logits: &'a [f32],
    /// An output for each image.
    y: Vec<&'a mut [f32]>,
}

impl<const SIDE: usize, const TAPS: usize> Leaf for Forward<'_, SIDE, TAPS> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(mut self) {
        let Shape {
            width,
            logits: channels,
            outputs,
            ..
        } = self.shape;
        for (row, logits) in self.logits.chunks_exact(width * channels).enumerate() {
            for (block, logits) in logits.chunks(BLOCK * channels).enumerate() {
                let kernels = kernels_of::<TAPS>(logits, channels);
                let blends = blends_of::<TAPS>(logits, channels);
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

struct Backward<'a, const SIDE: usize, const TAPS: usize> {
    shape: Shape,
    image: &'a PaddedRows,
    logits: &'a [f32],
    dy: &'a [f32],
    dlogits: &'a mut [f32],
}

impl<const SIDE: usize, const TAPS: usize> Leaf for Backward<'_, SIDE, TAPS> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Shape {
            width,
            logits: channels,
            outputs,
            ..
        } = self.shape;
        let rows = (self.logits.chunks_exact(width * channels))
            .zip(self.dy.chunks_exact(width * outputs))
            .zip(self.dlogits.chunks_exact_mut(width * channels));
        for (row, ((logits, dy), dlogits)) in rows.enumerate() {
            let blocks = (logits.chunks(BLOCK * channels))
                .zip(dy.chunks(BLOCK * outputs))
                .zip(dlogits.chunks_mut(BLOCK * channels));
            for (block, ((logits, dy), dlogits)) in blocks.enumerate() {
                let kernels = kernels_of::<TAPS>(logits, channels);
                let mut dcolors = [[0.0; BLOCK]; COLORS];
                for (pixel, dy) in dy.chunks_exact(outputs).enumerate() {
                    for (color, dy) in dcolors.iter_mut().zip(dy) {
                        color[pixel] = *dy;
                    }
                }
                let blends = blends_of::<TAPS>(logits, channels);
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
