//! The 4x4 deconvolution with stride 2 and padding 1, which doubles the size: fused bias and ReLU,
//! and its gradients.
//!
//! The output is divided into 2x2 *cells* that start one pixel outside it. All four pixels
//! (*phases*) of cell `(r, c)` depend on the same 2x2 inputs `(r - dy, c - dx)`, through the taps
//! `(2 dy + py, 2 dx + px)`. So the deconvolution is a sum of four products from `in` to `4 * out`
//! channels on `(H + 1) x (W + 1)` cells. Its gradients are products of the same two matrices.
//!
//! Inputs and outputs are stored in padded copies with `W + 1` cells per row. The single zero in a
//! row of inputs is the right border of that row and the left border of the next.

mod cells;
#[cfg(test)]
mod tests;
mod weights;

use rayon::prelude::*;

use crate::product::padded_rows;
use crate::rows::{self, Copy, Outer, Packed, Term, copy, whole};
use crate::scratch::{Scratch, Shared};
use crate::{Convolution, GradientSource, GradientTarget, Grid, Isa};
use cells::{CellRun, Cells};
use weights::{TAPS, packed};

/// `y = x * weight + bias`, rectified if `convolution.relu`.
///
/// # Shapes
/// `grid` is that of `x` `[B, H, W, in]`; `weight` `[in, out, 4, 4]`, `y` `[B, 2H, 2W, out]`.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, x: &[f32], convolution: Convolution, y: &mut [f32]) {
    let Convolution { weight, bias, .. } = convolution;
    check(grid, x.len(), weight.len(), bias.len(), y.len());
    PreparedDeconvolution::new(isa, convolution).forward(grid, x, 0, y);
}

/// A deconvolution whose weights are prepared once, for maps that come in bands of rows.
pub struct PreparedDeconvolution<'a> {
    isa: Isa,
    weights: [Packed; 4],
    bias: &'a [f32],
    relu: bool,
    inputs: usize,
}

impl<'a> PreparedDeconvolution<'a> {
    /// Prepares a deconvolution with a weight `[in, out, 4, 4]`.
    ///
    /// # Panics
    /// If a length does not match the others.
    pub fn new(isa: Isa, convolution: Convolution<'a>) -> Self {
        let Convolution { weight, bias, relu } = convolution;
        let outputs = bias.len();
        let inputs = weight.len() / (16 * outputs);
        assert_eq!(
            weight.len(),
            inputs * outputs * 16,
            "a weight of {inputs} to {outputs} channels"
        );
        let isa = isa.for_channels(outputs);
        let weights = packed(isa, weight, inputs, outputs, false);
        PreparedDeconvolution {
            isa,
            weights,
            bias,
            relu,
            inputs,
        }
    }

    /// Output channels.
    pub fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// Computes two output rows for each row of `x` from `above` on, until `y` is full. Outside `x`
    /// the input is zero. Where the image continues, `x` must hold one more row on that side.
    ///
    /// # Shapes
    /// `x` `[B, H, W, in]` with its `grid`, `y` `[B, 2 rows, 2W, out]`; several images only where
    /// `y` has all rows.
    ///
    /// # Panics
    /// If a length does not match the others.
    pub fn forward(&self, grid: Grid, x: &[f32], above: usize, y: &mut [f32]) {
        let PreparedDeconvolution {
            isa,
            weights,
            bias,
            relu,
            inputs,
        } = self;
        let (isa, relu, inputs, outputs) = (*isa, *relu, *inputs, bias.len());
        let row = grid.batch * 2 * grid.width * outputs;
        let height = y.len() / row;
        assert_eq!(
            x.len(),
            grid.pixels() * inputs,
            "a map of {inputs} channels on {grid:?}"
        );
        assert!(
            y.len() == height * row && height.is_multiple_of(2),
            "an output of {outputs} channels on twice {grid:?}"
        );
        assert!(
            above + height / 2 <= grid.height,
            "rows {above} to {} of {grid:?}",
            above + height / 2
        );
        assert!(
            grid.batch == 1 || height == 2 * grid.height,
            "a band of a single image"
        );
        let cells = Cells::new(grid);
        // Cells of the requested rows. A line of cells contributes one row above and one row below.
        let skipped = above * cells.across;
        let cell_count = if grid.batch == 1 {
            (height / 2 + 1) * cells.across
        } else {
            cells.count()
        };
        let padded = cells.inputs(isa, x, inputs);
        let wide = whole(4 * outputs);
        let step = rows::block_rows(cell_count);
        let target = OutputBand {
            isa,
            grid,
            above,
            height,
            bias,
            relu,
            y: Shared::new(y),
        };
        (0..cell_count.div_ceil(step))
            .into_par_iter()
            .for_each(|task| {
                let count = step.min(cell_count - task * step);
                let first = skipped + task * step;
                let terms: [Term; 4] = std::array::from_fn(|t| Term {
                    rows: &padded[(cells.offset(TAPS[t]) + first) * inputs..],
                    step: inputs,
                    weight: &weights[t],
                });
                let mut c = Scratch::take(padded_rows(count) * wide);
                rows::sum(isa, count, &terms, &mut c, wide);
                for run in cells.runs(first..first + count) {
                    let sums = &c[(run.first - first) * wide..];
                    // SAFETY: tasks write different cells.
                    unsafe { target.write(&run, sums) }
                }
            });
    }
}

/// Some rows of the output, written cell by cell: each has four pixels, its *phases*.
struct OutputBand<'a> {
    isa: Isa,
    /// Grid of the input.
    grid: Grid,
    /// Rows of the input above the band.
    above: usize,
    /// Rows of the output.
    height: usize,
    bias: &'a [f32],
    relu: bool,
    y: Shared,
}

impl OutputBand<'_> {
    /// Writes the pixels of a run of cells. `sums` `[cells, 4 out]`, each padded to whole vectors.
    ///
    /// # Safety
    /// No other thread writes these cells.
    unsafe fn write(&self, run: &CellRun, sums: &[f32]) {
        let (width, height) = (2 * self.grid.width, self.height);
        let outputs = self.bias.len();
        let wide = whole(4 * outputs);
        // The cells of a row are contiguous in two rows of the output.
        for phase in 0..4 {
            let (py, px) = (phase / 2, phase % 2);
            let Some(y_row) = (2 * run.row + py)
                .checked_sub(1 + 2 * self.above)
                .filter(|y| *y < height)
            else {
                continue;
            };
            // Skips cells whose pixel 2 * column + px - 1 does not exist.
            let skipped = usize::from(2 * run.column + px == 0);
            let past = usize::from(2 * (run.column + run.count - 1) + px > width);
            if skipped + past >= run.count {
                continue;
            }
            let rows = run.count - skipped - past;
            let pixel = (run.image * height + y_row) * width + 2 * (run.column + skipped) + px - 1;
            let len = ((rows - 1) * 2 + 1) * outputs;
            // SAFETY: a phase is one pixel of a cell, and the cells are this caller's. The slice also
            // spans pixels of other phases, which only this loop writes.
            let target = unsafe {
                std::slice::from_raw_parts_mut(self.y.pointer().add(pixel * outputs), len)
            };
            copy(
                self.isa,
                Copy {
                    from: &sums[skipped * wide + phase * outputs..],
                    from_step: wide,
                    gate: None,
                    bias: Some(self.bias),
                    relu: self.relu,
                    target,
                    target_step: 2 * outputs,
                    rows,
                    channels: outputs,
                },
            );
        }
    }
}

/// Gradients of [`forward`]. Overwrites all of `target`.
///
/// # Panics
/// If a length does not match the others.
pub fn backward(isa: Isa, grid: Grid, x: &[f32], source: GradientSource, target: GradientTarget) {
    let GradientSource { weight, y, dy } = source;
    let GradientTarget { dx, dweight, dbias } = target;
    let (inputs, outputs) = check(grid, x.len(), weight.len(), dbias.len(), dy.len());
    assert_eq!(dweight.len(), weight.len(), "a weight's gradient");
    assert!(
        y.is_none_or(|y| y.len() == dy.len()),
        "an output of {} values",
        dy.len()
    );
    let cells = Cells::new(grid);
    let wide = whole(4 * outputs);
    let (gradients, sums) = cells.gradients(isa, dy, y, outputs);
    for (dbias, sum) in dbias.iter_mut().zip(sums) {
        *dbias = sum as f32;
    }

    if let Some(dx) = dx {
        assert_eq!(dx.len(), x.len(), "an input's gradient");
        let weights = packed(isa, weight, inputs, outputs, true);
        input_gradient(isa, cells, &gradients, wide, &weights, inputs, dx);
    }

    let padded = cells.inputs(isa, x, inputs);
    let outers = TAPS.map(|tap| Outer {
        a: &padded[cells.offset(tap) * inputs..],
        a_step: inputs,
        rows: inputs,
        b: &gradients,
        b_step: wide,
        columns: 4 * outputs,
        pixels: cells.count(),
    });
    let products = rows::outer(isa, &outers, wide);
    let size = padded_rows(inputs) * wide;
    dweight
        .par_chunks_mut(outputs * 16)
        .enumerate()
        .for_each(|(input, dweight)| {
            let rows: [&[f32]; 4] =
                std::array::from_fn(|t| &products[t * size + input * wide..][..4 * outputs]);
            for (output, dweight) in dweight.chunks_exact_mut(16).enumerate() {
                for (t, dweight) in dweight.iter_mut().enumerate() {
                    let (y, x) = (t / 4, t % 4);
                    *dweight = rows[y / 2 * 2 + x / 2][(y % 2 * 2 + x % 2) * outputs + output];
                }
            }
        });
}

/// Writes `dx` `[B, H, W, in]` from the gradients of the cells, `[cells, wide]`.
fn input_gradient(
    isa: Isa,
    cells: Cells,
    gradients: &[f32],
    wide: usize,
    weights: &[Packed; 4],
    inputs: usize,
    dx: &mut [f32],
) {
    let grid = cells.grid;
    let c_step = whole(inputs);
    let step = rows::block_rows(cells.count());
    let shared = Shared::new(dx);
    (0..cells.count().div_ceil(step))
        .into_par_iter()
        .for_each(|task| {
            let first = task * step;
            let count = step.min(cells.count() - first);
            let terms: [Term; 4] = std::array::from_fn(|t| {
                let (dy, dx) = TAPS[t];
                Term {
                    rows: &gradients[(first + dy * cells.across + dx) * wide..],
                    step: wide,
                    weight: &weights[t],
                }
            });
            let mut c = Scratch::take(padded_rows(count) * c_step);
            rows::sum(isa, count, &terms, &mut c, c_step);
            for run in cells.runs(first..first + count) {
                // All cells of a row but the last are pixels of the input, in all rows but the last.
                let rows = run.count.min(grid.width - run.column);
                if run.row == grid.height || rows == 0 {
                    continue;
                }
                let pixel = (run.image * grid.height + run.row) * grid.width + run.column;
                // SAFETY: tasks write different pixels.
                let target = unsafe {
                    std::slice::from_raw_parts_mut(
                        shared.pointer().add(pixel * inputs),
                        rows * inputs,
                    )
                };
                copy(
                    isa,
                    Copy {
                        from: &c[(run.first - first) * c_step..],
                        from_step: c_step,
                        gate: None,
                        bias: None,
                        relu: false,
                        target,
                        target_step: inputs,
                        rows,
                        channels: inputs,
                    },
                );
            }
        });
}

fn check(grid: Grid, x: usize, weight: usize, outputs: usize, y: usize) -> (usize, usize) {
    let inputs = grid.channels(x);
    assert_eq!(
        y,
        grid.doubled().pixels() * outputs,
        "an output of {outputs} channels on twice {grid:?}"
    );
    assert_eq!(
        weight,
        inputs * outputs * 16,
        "a weight of {inputs} to {outputs} channels"
    );
    (inputs, outputs)
}
