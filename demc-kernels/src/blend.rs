//! The blend of a filtered image with a coarser one (Vogels et al. 2018).
//!
//! `o = y + b U(c - D(y))`. `y` is the filtered image of a level, `b` its blend weight, and `c` the
//! output of the level below. D is the 2x2 mean, U the bilinear doubling with half-pixel centres. So
//! `b` = 1 replaces the low frequencies of `y` by those of `c`.
//!
//! No operation is fused, so the bits are the same on every path.

use rayon::prelude::*;

use crate::Grid;
use crate::filter::COLORS;
use crate::scratch::Scratch;

/// Channels of a filtered image with its blend weight.
const BLENDED: usize = COLORS + 1;

/// The mean of each 2x2 window.
///
/// # Shapes
/// `x` on `grid`, `y` on `grid.halved()`, with the same number of channels. Height and width are
/// even.
///
/// # Panics
/// If a length does not match the others or a side is odd.
pub fn halve(grid: Grid, x: &[f32], y: &mut [f32]) {
    let channels = grid.channels(x.len());
    halve_first(grid, x, channels, y, channels);
}

/// As [`halve`], for the first `kept` of `channels` channels.
#[track_caller]
fn halve_first(grid: Grid, x: &[f32], channels: usize, y: &mut [f32], kept: usize) {
    assert!(
        grid.height.is_multiple_of(2) && grid.width.is_multiple_of(2),
        "{grid:?} has an odd side"
    );
    let half = grid.halved();
    assert_eq!(y.len(), half.pixels() * kept, "the mean on {half:?}");
    let row = grid.width * channels;
    y.par_chunks_mut(half.width * kept)
        .zip(x.par_chunks(2 * row))
        .for_each(|(y, x)| {
            let (top, bottom) = x.split_at(row);
            let pairs = top
                .chunks_exact(2 * channels)
                .zip(bottom.chunks_exact(2 * channels));
            for ((top, bottom), y) in pairs.zip(y.chunks_exact_mut(kept)) {
                for (c, y) in y.iter_mut().enumerate() {
                    *y = 0.25 * ((top[c] + top[channels + c]) + (bottom[c] + bottom[channels + c]));
                }
            }
        });
}

/// A filtered image with its blend weight, and the output of the level below.
#[derive(Clone, Copy, Debug)]
pub struct Scales<'a> {
    /// Filtered image and blend weight.
    pub filtered: &'a [f32],
    /// Output of the level below.
    pub coarse: &'a [f32],
}

impl Scales<'_> {
    #[track_caller]
    fn check(self, grid: Grid) {
        assert_eq!(
            self.filtered.len(),
            grid.pixels() * BLENDED,
            "the filtered image on {grid:?}"
        );
        assert_eq!(
            self.coarse.len(),
            grid.halved().pixels() * COLORS,
            "the coarse image on {grid:?}, halved"
        );
    }

    /// `c - D(y)`.
    fn correction(self, grid: Grid) -> Scratch {
        let mut correction = Scratch::take(self.coarse.len());
        halve_first(grid, self.filtered, BLENDED, &mut correction, COLORS);
        correction
            .par_iter_mut()
            .zip(self.coarse)
            .for_each(|(mean, coarse)| *mean = coarse - *mean);
        correction
    }
}

/// The blend of a filtered image and its blend weight with the output of the level below.
///
/// # Shapes
/// `filtered` of 4 channels and `out` of 3 on `grid`, `coarse` of 3 on `grid.halved()`. Height and
/// width are even.
///
/// # Panics
/// If a length does not match the others or a side is odd.
pub fn forward(grid: Grid, scales: Scales, out: &mut [f32]) {
    scales.check(grid);
    assert_eq!(out.len(), grid.pixels() * COLORS, "the output on {grid:?}");
    let filtered = scales.filtered;
    let correction = scales.correction(grid);
    let rows = Rows::of(grid);
    out.par_chunks_mut(grid.width * COLORS)
        .enumerate()
        .for_each(|(row, out)| {
            let mut doubled = Scratch::take(grid.width * COLORS);
            rows.double(&correction, row, &mut doubled);
            let filtered = &filtered[row * grid.width * BLENDED..(row + 1) * grid.width * BLENDED];
            let pixels = filtered
                .chunks_exact(BLENDED)
                .zip(doubled.chunks_exact(COLORS));
            for (out, (filtered, doubled)) in out.chunks_exact_mut(COLORS).zip(pixels) {
                for c in 0..COLORS {
                    out[c] = filtered[c] + filtered[COLORS] * doubled[c];
                }
            }
        });
}

/// The gradients of [`forward`] with respect to `filtered` and `coarse`.
///
/// # Shapes
/// As for `forward`; `dout` has the shape of `out`.
///
/// # Panics
/// If a length does not match the others or a side is odd.
pub fn backward(
    grid: Grid,
    scales: Scales,
    dout: &[f32],
    dfiltered: &mut [f32],
    dcoarse: &mut [f32],
) {
    scales.check(grid);
    let Scales { filtered, coarse } = scales;
    assert_eq!(
        dout.len(),
        grid.pixels() * COLORS,
        "the gradient on {grid:?}"
    );
    assert_eq!(
        dfiltered.len(),
        filtered.len(),
        "the filtered image and its gradient"
    );
    assert_eq!(
        dcoarse.len(),
        coarse.len(),
        "the coarse image and its gradient"
    );
    let correction = scales.correction(grid);
    let rows = Rows::of(grid);
    let (row_in, row_out) = (grid.width * BLENDED, grid.width * COLORS);
    // The gradient of the doubled correction, and that of the blend weight.
    let mut ddoubled = Scratch::take(dout.len());
    ddoubled
        .par_chunks_mut(row_out)
        .zip(dfiltered.par_chunks_mut(row_in))
        .enumerate()
        .for_each(|(row, (ddoubled, dfiltered))| {
            let mut doubled = Scratch::take(row_out);
            rows.double(&correction, row, &mut doubled);
            let filtered = filtered[row * row_in..(row + 1) * row_in].chunks_exact(BLENDED);
            let dout = dout[row * row_out..(row + 1) * row_out].chunks_exact(COLORS);
            let pixels = filtered.zip(dout).zip(doubled.chunks_exact(COLORS));
            let targets = ddoubled
                .chunks_exact_mut(COLORS)
                .zip(dfiltered.chunks_exact_mut(BLENDED));
            for ((ddoubled, dfiltered), ((filtered, dout), doubled)) in targets.zip(pixels) {
                for c in 0..COLORS {
                    ddoubled[c] = filtered[COLORS] * dout[c];
                }
                dfiltered[COLORS] =
                    dout[0] * doubled[0] + dout[1] * doubled[1] + dout[2] * doubled[2];
            }
        });
    let half = grid.halved();
    dcoarse
        .par_chunks_mut(half.width * COLORS)
        .enumerate()
        .for_each(|(row, dcoarse)| {
            rows.halve_transposed(&ddoubled, row, dcoarse);
        });
    dfiltered
        .par_chunks_mut(row_in)
        .enumerate()
        .for_each(|(row, dfiltered)| {
            let half_row = row / 2 * half.width * COLORS;
            for (column, target) in dfiltered.chunks_exact_mut(BLENDED).enumerate() {
                let below = half_row + column / 2 * COLORS;
                for c in 0..COLORS {
                    target[c] =
                        dout[row * row_out + column * COLORS + c] - 0.25 * dcoarse[below + c];
                }
            }
        });
}

/// Rows of the images of a batch, doubled and back.
#[derive(Clone, Copy)]
struct Rows {
    /// Of the halved image.
    height: usize,
    width: usize,
}

impl Rows {
    fn of(grid: Grid) -> Self {
        let half = grid.halved();
        Rows {
            height: half.height,
            width: half.width,
        }
    }

    /// Row `row` of the doubled batch: a quarter of the farther row or column, three of the nearer.
    fn double(self, x: &[f32], row: usize, out: &mut [f32]) {
        let (image, row) = (row / (2 * self.height), row % (2 * self.height));
        let line = |row: usize| {
            let first = (image * self.height + row) * self.width * COLORS;
            &x[first..first + self.width * COLORS]
        };
        let (near, far) = (line(row / 2), line(neighbour(row, self.height)));
        let value = |column: usize, c: usize| {
            0.75 * near[column * COLORS + c] + 0.25 * far[column * COLORS + c]
        };
        for (column, out) in out.chunks_exact_mut(COLORS).enumerate() {
            let beside = neighbour(column, self.width);
            for (c, out) in out.iter_mut().enumerate() {
                *out = 0.75 * value(column / 2, c) + 0.25 * value(beside, c);
            }
        }
    }

    /// Row `row` of the gradient of the halved batch from that of the doubled one.
    fn halve_transposed(self, dout: &[f32], row: usize, dx: &mut [f32]) {
        let (image, row) = (row / self.height, row % self.height);
        dx.fill(0.0);
        let first = image * 2 * self.height;
        for (source, vertical) in shares(row, self.height) {
            let from = (first + source) * 2 * self.width * COLORS;
            let line = &dout[from..from + 2 * self.width * COLORS];
            for (column, dx) in dx.chunks_exact_mut(COLORS).enumerate() {
                for (source, horizontal) in shares(column, self.width) {
                    for (c, dx) in dx.iter_mut().enumerate() {
                        *dx += vertical * horizontal * line[source * COLORS + c];
                    }
                }
            }
        }
    }
}

/// The halved row or column that contributes a quarter to the doubled one.
fn neighbour(doubled: usize, length: usize) -> usize {
    if doubled.is_multiple_of(2) {
        (doubled / 2).saturating_sub(1)
    } else {
        (doubled / 2 + 1).min(length - 1)
    }
}

/// The doubled rows or columns that a halved one contributes to, with its share. Where the border is
/// replicated, the two quarters of one row are one.
fn shares(halved: usize, length: usize) -> impl Iterator<Item = (usize, f32)> {
    let own = 2 * halved;
    let first = if halved == 0 { 1.0 } else { 0.75 };
    let last = if halved + 1 == length { 1.0 } else { 0.75 };
    let before = (halved > 0).then(|| (own - 1, 0.25));
    let after = (halved + 1 < length).then(|| (own + 2, 0.25));
    before
        .into_iter()
        .chain([(own, first), (own + 1, last)])
        .chain(after)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference;
    use crate::testing::{
        assert_close, assert_within, bits, f64s, few, pattern, same_on_any_number_of_threads,
    };

    fn even_grids() -> Vec<Grid> {
        let sizes = vec![(1, 2, 2), (2, 4, 6), (1, 2, 8), (1, 24, 32)];
        let grids = few(sizes, 2).into_iter();
        grids
            .map(|(batch, height, width)| Grid {
                batch,
                height,
                width,
            })
            .collect()
    }

    fn case(grid: Grid) -> [Vec<f32>; 3] {
        let pixels = grid.pixels();
        [
            pattern(4 * pixels, 1),
            pattern(3 * pixels / 4, 2),
            pattern(3 * pixels, 3),
        ]
    }

    #[test]
    fn it_is_the_plain_sum() {
        for grid in even_grids() {
            let [filtered, coarse, mut out] = case(grid);
            let scales = Scales {
                filtered: &filtered,
                coarse: &coarse,
            };
            forward(grid, scales, &mut out);
            let expected = reference::blend(grid, &f64s(&filtered), &f64s(&coarse));
            assert_close(&format!("{grid:?}"), &out, &expected);
        }
    }

    /// Central differences of the float64 loops.
    #[test]
    fn the_gradients_are_those_of_differences() {
        for grid in even_grids() {
            let [filtered, coarse, dout] = case(grid);
            let mut gradients = [vec![f32::NAN; filtered.len()], vec![f32::NAN; coarse.len()]];
            let [dfiltered, dcoarse] = &mut gradients;
            let scales = Scales {
                filtered: &filtered,
                coarse: &coarse,
            };
            backward(grid, scales, &dout, dfiltered, dcoarse);
            let inputs = [f64s(&filtered), f64s(&coarse)];
            let sum = |inputs: &[Vec<f64>; 2]| -> f64 {
                let out = reference::blend(grid, &inputs[0], &inputs[1]);
                out.iter()
                    .zip(&dout)
                    .map(|(out, dout)| out * f64::from(*dout))
                    .sum()
            };
            for part in 0..2 {
                for i in 0..inputs[part].len().min(200) {
                    let mut moved = inputs.clone();
                    moved[part][i] += 1e-4;
                    let above = sum(&moved);
                    moved[part][i] -= 2e-4;
                    let expected = (above - sum(&moved)) / 2e-4;
                    assert_within(
                        &format!("{grid:?} {part} {i}"),
                        &[gradients[part][i]],
                        &[expected],
                        2e-6,
                    );
                }
            }
        }
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes minutes")]
    fn bits_do_not_depend_on_the_threads() {
        let grid = Grid {
            batch: 2,
            height: 40,
            width: 36,
        };
        let [filtered, coarse, dout] = case(grid);
        let scales = Scales {
            filtered: &filtered,
            coarse: &coarse,
        };
        same_on_any_number_of_threads(|| {
            let (mut out, mut d, mut dc) = (dout.clone(), filtered.clone(), coarse.clone());
            forward(grid, scales, &mut out);
            backward(grid, scales, &dout, &mut d, &mut dc);
            [bits(&out), bits(&d), bits(&dc)]
        });
    }

    #[test]
    fn one_flat_image_on_both_levels_stays_flat() {
        let grid = Grid {
            batch: 1,
            height: 4,
            width: 4,
        };
        let filtered: Vec<f32> = [0.3, 0.3, 0.3, 0.8].repeat(16);
        let mut out = vec![0.0; 48];
        let scales = Scales {
            filtered: &filtered,
            coarse: &[0.3; 12],
        };
        forward(grid, scales, &mut out);
        assert!(out.iter().all(|out| (out - 0.3).abs() < 1e-6));
    }
}
