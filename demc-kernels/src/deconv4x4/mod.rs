//! The 4x4 deconvolution with stride 2 and padding 1 (exactly twice the size): bias and ReLU fused, and its gradients.
//!
//! With the output cut into 2x2 *cells* that start one pixel outside of it, all four pixels (*phases*) of cell `(r, c)`
//! come from the same 2x2 inputs `(r - dy, c - dx)`, by the taps `(2 dy + py, 2 dx + px)`. So the deconvolution is one
//! sum of four products from `in` to `4 * out` channels on `(H + 1) x (W + 1)` cells, and its gradients are products of
//! the same two matrices.
//!
//! Both live in padded copies with `W + 1` cells a row: the input's one zero a row is the right border of a row and the
//! left one of the next.

mod cells;
#[cfg(test)]
mod tests;
mod weights;

use rayon::prelude::*;

use crate::product::padded_rows;
use crate::rows::{self, Copy, Outer, Packed, Term, copy, whole};
use crate::scratch::{Scratch, Shared};
use crate::{Grid, Isa};
use cells::Cells;
use weights::packed;

/// The 2x2 inputs of a cell.
const TAPS: [(usize, usize); 4] = [(0, 0), (0, 1), (1, 0), (1, 1)];

/// `y = x * weight + bias`, rectified where `relu`.
///
/// # Shapes
/// `grid` is that of `x` `[B, H, W, in]`; `weight` `[in, out, 4, 4]`, `bias` `[out]`, `y` `[B, 2H, 2W, out]`.
///
/// # Panics
/// Where the lengths do not fit.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub fn forward(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    relu: bool,
    y: &mut [f32],
) {
    check(grid, x.len(), weight.len(), bias.len(), y.len());
    Ready::new(isa, weight, bias, relu).forward(grid, x, 0, y);
}

/// A deconvolution whose weights are prepared once, for maps that come in bands of rows.
pub struct Ready<'a> {
    isa: Isa,
    weights: [Packed; 4],
    bias: &'a [f32],
    relu: bool,
    inputs: usize,
}

impl<'a> Ready<'a> {
    /// Of `weight` `[in, out, 4, 4]` and `bias` `[out]`, rectified where `relu`.
    ///
    /// # Panics
    /// Where the lengths do not fit.
    pub fn new(isa: Isa, weight: &[f32], bias: &'a [f32], relu: bool) -> Self {
        let outputs = bias.len();
        let inputs = weight.len() / (16 * outputs);
        assert_eq!(
            weight.len(),
            inputs * outputs * 16,
            "a weight of {inputs} to {outputs} channels"
        );
        let weights = packed(isa, weight, inputs, outputs, false);
        Ready {
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

    /// Makes of the rows of `x` from `above` on as many as `y` has, twice as many as they are. Beyond the rows of `x` are
    /// zeros: where an image goes on there, `x` holds a row more on that side.
    ///
    /// # Shapes
    /// `x` `[B, H, W, in]` with its `grid`, `y` `[B, 2 rows, 2W, out]`; several images only where `y` has all rows.
    ///
    /// # Panics
    /// Where the lengths do not fit.
    pub fn forward(&self, grid: Grid, x: &[f32], above: usize, y: &mut [f32]) {
        let Ready {
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
        // Those of the asked rows: a line of cells gives a row to the one above and a row to the one below.
        let skipped = above * cells.across;
        let cell_count = if grid.batch == 1 {
            (height / 2 + 1) * cells.across
        } else {
            cells.count()
        };
        let padded = cells.inputs(isa, x, inputs);
        let wide = whole(4 * outputs);
        let step = rows::block_rows(cell_count);
        let shared = Shared::new(y);
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
                // The cells of a row lie side by side in two rows of the output.
                let mut cell = first;
                while cell < first + count {
                    let (line, column) = (cell / cells.across, cell % cells.across);
                    let (image, row) = (line / (grid.height + 1), line % (grid.height + 1));
                    let run = (cells.across - column).min(first + count - cell);
                    for phase in 0..4 {
                        let (py, px) = (phase / 2, phase % 2);
                        let Some(y_row) = (2 * row + py)
                            .checked_sub(1 + 2 * above)
                            .filter(|y| *y < height)
                        else {
                            continue;
                        };
                        // Cells whose pixel 2 * column + px - 1 exists.
                        let skipped = usize::from(2 * column + px == 0);
                        let past = usize::from(2 * (column + run - 1) + px > 2 * grid.width);
                        if skipped + past >= run {
                            continue;
                        }
                        let rows = run - skipped - past;
                        let pixel =
                            (image * height + y_row) * 2 * grid.width + 2 * (column + skipped) + px
                                - 1;
                        let len = ((rows - 1) * 2 + 1) * outputs;
                        // SAFETY: tasks write the pixels of different cells, and a phase is one pixel of a cell; the slice spans
                        // pixels of other phases too, which nobody but this task's own loop writes meanwhile.
                        let to = unsafe {
                            std::slice::from_raw_parts_mut(
                                shared.pointer().add(pixel * outputs),
                                len,
                            )
                        };
                        copy(
                            isa,
                            Copy {
                                from: &c[(cell - first + skipped) * wide + phase * outputs..],
                                from_step: wide,
                                gate: None,
                                bias: Some(bias),
                                relu,
                                to,
                                to_step: 2 * outputs,
                                rows,
                                channels: outputs,
                            },
                        );
                    }
                    cell += run;
                }
            });
    }
}

/// Gradients of [`forward`] for `dy`, the gradient by `y`: `dx` where asked for, `dweight`, `dbias`, all overwritten.
///
/// `y` is the output where it was rectified: `dy` then counts where `y` is positive.
///
/// # Shapes
/// As in [`forward`]; a gradient has the shape of its value.
///
/// # Panics
/// Where the lengths do not fit.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub fn backward(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    weight: &[f32],
    y: Option<&[f32]>,
    dy: &[f32],
    dx: Option<&mut [f32]>,
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
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
                // Of the cells of a row all but the last are pixels of the input, of the rows all but the last.
                let mut cell = first;
                while cell < first + count {
                    let (line, column) = (cell / cells.across, cell % cells.across);
                    let (image, row) = (line / (grid.height + 1), line % (grid.height + 1));
                    let run = (cells.across - column).min(first + count - cell);
                    let rows = run.min(grid.width - column);
                    if row < grid.height && rows > 0 {
                        let pixel = (image * grid.height + row) * grid.width + column;
                        // SAFETY: tasks write different pixels.
                        let to = unsafe {
                            std::slice::from_raw_parts_mut(
                                shared.pointer().add(pixel * inputs),
                                rows * inputs,
                            )
                        };
                        copy(
                            isa,
                            Copy {
                                from: &c[(cell - first) * c_step..],
                                from_step: c_step,
                                gate: None,
                                bias: None,
                                relu: false,
                                to,
                                to_step: inputs,
                                rows,
                                channels: inputs,
                            },
                        );
                    }
                    cell += run;
                }
            });
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

/// Input and output channels.
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
