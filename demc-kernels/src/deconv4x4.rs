//! The 4x4 deconvolution with stride 2 and padding 1 (exactly twice the size): bias and ReLU fused, and its gradients.
//!
//! With the output cut into 2x2 *cells* that start one pixel outside of it, all four pixels (*phases*) of cell `(r, c)`
//! come from the same 2x2 inputs `(r - dy, c - dx)`, by the taps `(2 dy + py, 2 dx + px)`. So the deconvolution is one
//! sum of four products from `in` to `4 * out` channels on `(H + 1) x (W + 1)` cells, and its gradients are products of
//! the same two matrices.
//!
//! Both live in padded copies with `W + 1` cells a row: the input's one zero a row is the right border of a row and the
//! left one of the next.

use rayon::prelude::*;

use crate::product::padded_rows;
use crate::rows::{self, BLOCK, Copy, Outer, Packed, Term, Window, copy, whole};
use crate::scratch::{Scratch, Shared};
use crate::{Grid, Isa};

/// The 2x2 inputs of a cell.
const TAPS: [(usize, usize); 4] = [(0, 0), (0, 1), (1, 0), (1, 1)];

/// The cells of a grid of inputs.
#[derive(Clone, Copy)]
struct Cells {
    grid: Grid,
    /// Cells of a row.
    across: usize,
}

impl Cells {
    fn new(grid: Grid) -> Self {
        Cells { grid, across: grid.width + 1 }
    }

    /// Cells of an image.
    fn of_image(self) -> usize {
        (self.grid.height + 1) * self.across
    }

    /// Rows of a padded input of an image: a row of zeros before and after it, and what the products read beyond.
    fn padded(self) -> usize {
        (self.grid.height + 2) * self.across + 1
    }

    /// The padded input, pixel `(y, x)` of an image at row `(y + 1) * across + x + 1`.
    fn inputs(self, isa: Isa, x: &[f32], channels: usize) -> Scratch {
        let Grid { batch, height, width } = self.grid;
        let mut padded = Scratch::zeroed(batch * self.padded() * channels + padded_rows(BLOCK) * channels);
        let images = padded.par_chunks_mut(self.padded() * channels).take(batch);
        images.zip(x.par_chunks(height * width * channels)).for_each(|(padded, x)| {
            for (row, x) in x.chunks(width * channels).enumerate() {
                let first = ((row + 1) * self.across + 1) * channels;
                padded[first..first + x.len()].copy_from_slice(x);
            }
        });
        let _ = isa;
        padded
    }

    /// First row of the padded inputs that cell 0 of an image reads at a tap.
    fn offset(self, image: usize, (dy, dx): (usize, usize)) -> usize {
        image * self.padded() + self.across + 1 - dy * self.across - dx
    }

    /// The gradient by cells, `4 * channels` a cell, gated; and its sum over pixels, by rows of cells.
    fn gradients(self, isa: Isa, dy: &[f32], y: Option<&[f32]>, channels: usize) -> (Scratch, Vec<f64>) {
        let Grid { batch, height, width } = self.grid;
        let wide = whole(4 * channels);
        let lines = batch * (height + 1);
        let mut cells = Scratch::zeroed((lines * self.across + padded_rows(BLOCK)) * wide);
        let mut sums = vec![0.0f64; lines * channels];
        let all = cells.par_chunks_mut(self.across * wide).take(lines).zip(sums.par_chunks_mut(channels));
        all.enumerate().for_each(|(line, (cells, sums))| {
            let (image, row) = (line / (height + 1), line % (height + 1));
            for py in 0..2 {
                let Some(y_row) = (2 * row + py).checked_sub(1).filter(|y| *y < 2 * height) else { continue };
                let first = ((image * 2 * height + y_row) * 2 * width) * channels;
                for px in 0..2 {
                    // Pixels px - 1, px + 1, ...: from the first that exists.
                    let skipped = 1 - px;
                    let from = first + (px + 2 * skipped - 1) * channels;
                    let to = &mut cells[skipped * wide + (2 * py + px) * channels..];
                    copy(isa, Copy {
                        from: &dy[from..], from_step: 2 * channels, gate: y.map(|y| &y[from..]), bias: None, relu: false,
                        to: &mut *to, to_step: wide, rows: width, channels,
                    });
                    rows::column_sums(to, wide, width, channels, sums);
                }
            }
        });
        let total = (0..channels).map(|o| sums[o..].iter().step_by(channels).sum()).collect();
        (cells, total)
    }
}

/// Place in a weight `[in, out, 4, 4]`.
fn place(outputs: usize, input: usize, column: usize, (dy, dx): (usize, usize)) -> usize {
    let (phase, output) = (column / outputs, column % outputs);
    (input * outputs + output) * 16 + (2 * dy + phase / 2) * 4 + 2 * dx + phase % 2
}

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
    let (inputs, outputs) = check(grid, x.len(), weight.len(), bias.len(), y.len());
    let cells = Cells::new(grid);
    let weights = TAPS.map(|tap| Packed::new(isa, inputs, 4 * outputs, |k, column| weight[place(outputs, k, column, tap)]));
    let padded = cells.inputs(isa, x, inputs);
    let wide = whole(4 * outputs);
    let step = if wide > 512 { BLOCK / 2 } else { BLOCK };
    let of_image = cells.of_image();
    let blocks = of_image.div_ceil(step);
    let shared = Shared::new(y);
    (0..grid.batch * blocks).into_par_iter().for_each(|task| {
        let (image, first) = (task / blocks, task % blocks * step);
        let count = step.min(of_image - first);
        let terms: [Term; 4] = std::array::from_fn(|t| Term {
            rows: &padded[(cells.offset(image, TAPS[t]) + first) * inputs..],
            step: inputs,
            weight: &weights[t],
        });
        let mut c = Scratch::take(padded_rows(count) * wide);
        rows::sum(isa, count, &terms, &mut c, wide);
        // The cells of a row lie side by side in two rows of the output.
        let mut cell = first;
        while cell < first + count {
            let (row, column) = (cell / cells.across, cell % cells.across);
            let run = (cells.across - column).min(first + count - cell);
            for phase in 0..4 {
                let (py, px) = (phase / 2, phase % 2);
                let Some(y_row) = (2 * row + py).checked_sub(1).filter(|y| *y < 2 * grid.height) else { continue };
                // Cells whose pixel 2 * column + px - 1 exists.
                let skipped = usize::from(2 * column + px == 0);
                let past = usize::from(2 * (column + run - 1) + px > 2 * grid.width);
                if skipped + past >= run {
                    continue;
                }
                let rows = run - skipped - past;
                let pixel = (image * 2 * grid.height + y_row) * 2 * grid.width + 2 * (column + skipped) + px - 1;
                let len = ((rows - 1) * 2 + 1) * outputs;
                // SAFETY: tasks write the pixels of different cells, and a phase is one pixel of a cell; the slice spans
                // pixels of other phases too, which nobody but this task's own loop writes through it.
                let to = unsafe { std::slice::from_raw_parts_mut(shared.pointer().add(pixel * outputs), len) };
                copy(isa, Copy {
                    from: &c[(cell - first + skipped) * wide + phase * outputs..], from_step: wide, gate: None,
                    bias: Some(bias), relu, to, to_step: 2 * outputs, rows, channels: outputs,
                });
            }
            cell += run;
        }
    });
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
    assert!(y.is_none_or(|y| y.len() == dy.len()), "an output of {} values", dy.len());
    let cells = Cells::new(grid);
    let wide = whole(4 * outputs);
    let (gradients, sums) = cells.gradients(isa, dy, y, outputs);
    for (dbias, sum) in dbias.iter_mut().zip(sums) {
        *dbias = sum as f32;
    }
    let of_image = cells.of_image();

    if let Some(dx) = dx {
        assert_eq!(dx.len(), x.len(), "an input's gradient");
        let weights = TAPS.map(|tap| Packed::new(isa, 4 * outputs, inputs, |column, k| weight[place(outputs, k, column, tap)]));
        let c_step = whole(inputs);
        // Whole rows of cells, about a block of them.
        let lines = (BLOCK / cells.across).clamp(1, grid.height);
        let tasks = grid.height.div_ceil(lines);
        let shared = Shared::new(dx);
        (0..grid.batch * tasks).into_par_iter().for_each(|task| {
            let (image, line) = (task / tasks, task % tasks * lines);
            let lines = lines.min(grid.height - line);
            let count = lines * cells.across - 1;
            let windows: [Window; 4] = std::array::from_fn(|t| {
                let (dy, dx) = TAPS[t];
                Window::new(&gradients, wide, image * of_image + (line + dy) * cells.across + dx, count)
            });
            let terms: [Term; 4] = std::array::from_fn(|t| Term { rows: windows[t].rows(), step: wide, weight: &weights[t] });
            let mut c = Scratch::take(padded_rows(count) * c_step);
            rows::sum(isa, count, &terms, &mut c, c_step);
            for row in 0..lines {
                let first = (image * grid.height + line + row) * grid.width * inputs;
                // SAFETY: tasks write different rows of `dx`.
                let to = unsafe { std::slice::from_raw_parts_mut(shared.pointer().add(first), grid.width * inputs) };
                copy(isa, Copy {
                    from: &c[row * cells.across * c_step..], from_step: c_step, gate: None, bias: None, relu: false,
                    to, to_step: inputs, rows: grid.width, channels: inputs,
                });
            }
        });
    }

    let padded = cells.inputs(isa, x, inputs);
    let mut sum: Option<Scratch> = None;
    for image in 0..grid.batch {
        let outers = TAPS.map(|tap| Outer {
            a: &padded[cells.offset(image, tap) * inputs..],
            a_step: inputs,
            rows: inputs,
            b: &gradients[image * of_image * wide..],
            b_step: wide,
            columns: 4 * outputs,
            pixels: of_image,
        });
        let products = rows::outer(isa, &outers, wide);
        match &mut sum {
            None => sum = Some(products),
            Some(sum) => {
                sum.par_chunks_mut(1 << 14).zip(products.par_chunks(1 << 14)).for_each(|(sum, product)| {
                    for (sum, product) in sum.iter_mut().zip(product) {
                        *sum += product;
                    }
                });
            }
        }
    }
    let Some(sum) = sum else { return };
    let size = padded_rows(inputs) * wide;
    dweight.par_chunks_mut(outputs * 16).enumerate().for_each(|(input, dweight)| {
        for (t, tap) in TAPS.into_iter().enumerate() {
            let row = &sum[t * size + input * wide..][..4 * outputs];
            for (column, value) in row.iter().enumerate() {
                dweight[place(outputs, 0, column, tap)] = *value;
            }
        }
    });
}

/// Input and output channels.
fn check(grid: Grid, x: usize, weight: usize, outputs: usize, y: usize) -> (usize, usize) {
    let inputs = grid.channels(x);
    assert_eq!(y, grid.doubled().pixels() * outputs, "an output of {outputs} channels on twice {grid:?}");
    assert_eq!(weight, inputs * outputs * 16, "a weight of {inputs} to {outputs} channels");
    (inputs, outputs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference;
    use crate::testing::{assert_close, f64s, grids, pattern};

    #[test]
    fn equals_the_reference_on_every_path_at_odd_sizes() {
        for isa in Isa::available() {
            for grid in grids() {
                for (inputs, outputs) in [(1, 1), (6, 5), (17, 8), (33, 20)] {
                    for relu in [false, true] {
                        let x = pattern(grid.pixels() * inputs, 1);
                        let (weight, bias) = (pattern(inputs * outputs * 16, 2), pattern(outputs, 3));
                        let dy = pattern(grid.doubled().pixels() * outputs, 4);
                        let name = format!("{isa} {grid:?} {inputs} to {outputs}");
                        let mut y = vec![f32::NAN; dy.len()];
                        forward(isa, grid, &x, &weight, &bias, relu, &mut y);
                        let expected = reference::deconv4x4(grid, &f64s(&x), &f64s(&weight), &f64s(&bias), relu);
                        assert_close(&format!("{name} y"), &y, &expected);

                        let gate = relu.then_some(&y[..]);
                        let gated = match gate {
                            Some(y) => reference::gated(&f64s(&dy), &f64s(y)),
                            None => f64s(&dy),
                        };
                        let expected = reference::deconv4x4_backward(grid, &f64s(&x), &f64s(&weight), &gated);
                        let mut dx = vec![f32::NAN; x.len()];
                        let mut dweight = vec![f32::NAN; weight.len()];
                        let mut dbias = vec![f32::NAN; outputs];
                        backward(isa, grid, &x, &weight, gate, &dy, Some(&mut dx), &mut dweight, &mut dbias);
                        assert_close(&format!("{name} dx"), &dx, &expected.dx);
                        assert_close(&format!("{name} dweight"), &dweight, &expected.dweight);
                        assert_close(&format!("{name} dbias"), &dbias, &expected.dbias);
                    }
                }
            }
        }
    }
}
