//! 3x3 convolutions with few channels on one side (the first and the last of the network), as plain
//! sums.
//!
//! Few inputs: three products, one for each line of the 3x3 neighbourhood. The gradient of the weight
//! is one product with the whole neighbourhoods as rows of `9 * in` values (*im2col*).
//!
//! Few outputs: such a product would leave most lanes of a vector empty. Instead, one product
//! computes all `9 * out` values that a pixel contributes to its neighbours. These are then
//! collected (*col2im*).

mod collect;
mod gather;

use std::ops::Range;

use rayon::prelude::*;

use super::parts::{BiasRelu, GatedMap, ThinConvolution};
use crate::product::padded_rows;
use crate::rows::{self, BLOCK, Outer, Packed, Term, whole};
use crate::scratch::Scratch;
use crate::{Grid, Isa};
use collect::collect;

/// Maximum number of output values over all taps for which collecting pays off.
const MOST_COLLECTED: usize = 36;

/// `y = epilogue(weight * source)` for the rows from `above` on, as many as `y` has.
///
/// # Panics
/// If there are several images and `y` does not have all their rows.
pub(crate) fn convolve(
    isa: Isa,
    operands: ThinConvolution,
    above: usize,
    epilogue: BiasRelu,
    y: &mut [f32],
) {
    let ThinConvolution { grid, axes, .. } = operands;
    let height = y.len() / (grid.batch * grid.width * axes.outputs);
    assert!(
        above + height <= grid.height,
        "rows {above} to {} of {grid:?}",
        above + height
    );
    assert!(
        grid.batch == 1 || height == grid.height,
        "a band of a single image"
    );
    if 9 * axes.outputs <= MOST_COLLECTED && axes.inputs > axes.outputs {
        collect(isa, operands, above, epilogue, y);
    } else {
        spread(isa, operands, above, epilogue, y);
    }
}

/// Convolves by lines. An output pixel reads three pixels of a line: `3 * in` values side by side. Those of
/// the next output pixel begin `in` values later. So a line is the left operand of a product as it is, and
/// the convolution is a sum of three of them.
fn spread(isa: Isa, operands: ThinConvolution, above: usize, epilogue: BiasRelu, y: &mut [f32]) {
    let ThinConvolution {
        grid,
        source,
        weight,
        axes,
    } = operands;
    let (inputs, columns) = (axes.inputs, axes.outputs);
    let weights: [Packed; 3] = std::array::from_fn(|line| {
        Packed::new(isa, 3 * inputs, columns, |k, column| {
            weight[axes.place(k % inputs, column, 3 * line + k / inputs)]
        })
    });
    let height = y.len() / (grid.batch * grid.width * columns);
    let piece = grid.width.div_ceil(grid.width.div_ceil(BLOCK));
    let rows = y.par_chunks_mut(grid.width * columns).enumerate();
    rows.for_each(|(row, y)| {
        let (image, row) = (row / height, above + row % height);
        // An image's line and the zeros on both sides, with room for whole blocks of rows.
        let step = (padded_rows(piece) + 2) * inputs;
        let mut lines = Scratch::take(3 * step);
        for (index, y) in y.chunks_mut(piece * columns).enumerate() {
            let (first, count) = (index * piece, y.len() / columns);
            for (line, values) in lines.chunks_exact_mut(step).enumerate() {
                let values = &mut values[..(count + 2) * inputs];
                source.line(isa, grid, image, (row + line).checked_sub(1), first, values);
            }
            let terms: [Term; 3] = std::array::from_fn(|line| Term {
                rows: &lines[line * step..][..step],
                step: inputs,
                weight: &weights[line],
            });
            rows::write_sum(isa, &terms, false, epilogue.bias, epilogue.relu, y);
        }
    });
}

/// Number of stretches of pixels for a gradient. One task sums each stretch; the sums are added in
/// order.
const STRETCHES: usize = 16;

/// Gradients with respect to the weight `[out, in, 3, 3]` and the bias.
pub(crate) fn gradient(
    isa: Isa,
    grid: Grid,
    x: GatedMap,
    dy: GatedMap,
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
    let (inputs, outputs) = (x.channels, dy.channels);
    let products = WeightProducts::new(isa, grid, x, dy);
    let WeightProducts {
        by_output,
        rows,
        columns,
        ..
    } = products;
    let pixels = grid.pixels();
    let stretch = pixels.div_ceil(STRETCHES).next_multiple_of(BLOCK);
    let stretches = pixels.div_ceil(stretch);
    let wide = whole(columns);
    let size = padded_rows(rows + 1) * wide;
    let mut sums = Scratch::zeroed(stretches * size);
    sums.par_chunks_mut(size)
        .enumerate()
        .for_each(|(index, sum)| {
            products.add(index * stretch..((index + 1) * stretch).min(pixels), sum);
        });
    let total = |row: usize, column: usize| -> f32 {
        (0..stretches)
            .map(|s| sums[s * size + row * wide + column])
            .sum()
    };
    for o in 0..outputs {
        for i in 0..inputs {
            for tap in 0..9 {
                dweight[(o * inputs + i) * 9 + tap] = if by_output {
                    total(i, tap * outputs + o)
                } else {
                    total(tap * inputs + i, o)
                };
            }
        }
        // The middle tap of the neighbourhoods of `dy` is `dy` itself.
        dbias[o] = total(rows, if by_output { 4 * outputs + o } else { o });
    }
}

/// The products whose sum over the pixels is the gradient of the weight. The neighbourhoods of the
/// thin side become their rows or columns.
#[derive(Clone, Copy)]
struct WeightProducts<'a> {
    isa: Isa,
    grid: Grid,
    x: GatedMap<'a>,
    dy: GatedMap<'a>,
    /// Neighbourhoods of `dy` beside pixels of `x`; otherwise the reverse.
    by_output: bool,
    /// Rows, without an extra row of ones: its product is the sum of `dy`, the gradient of the bias.
    rows: usize,
    columns: usize,
}

impl<'a> WeightProducts<'a> {
    fn new(isa: Isa, grid: Grid, x: GatedMap<'a>, dy: GatedMap<'a>) -> Self {
        let (inputs, outputs) = (x.channels, dy.channels);
        let by_output = 9 * outputs <= MOST_COLLECTED && inputs > outputs;
        let (rows, columns) = if by_output {
            (inputs, 9 * outputs)
        } else {
            (9 * inputs, outputs)
        };
        WeightProducts {
            isa,
            grid,
            x,
            dy,
            by_output,
            rows,
            columns,
        }
    }

    /// Adds the products of these pixels to `sum`: `rows + 1` rows, each padded to whole vectors of
    /// `columns`.
    fn add(&self, pixels: Range<usize>, sum: &mut [f32]) {
        let WeightProducts {
            isa, grid, x, dy, ..
        } = *self;
        let (tall, wide) = (padded_rows(self.rows + 1), whole(self.columns));
        let mut a = Scratch::zeroed(BLOCK * tall);
        a.iter_mut()
            .skip(self.rows)
            .step_by(tall)
            .for_each(|one| *one = 1.0);
        let mut b = Scratch::zeroed(BLOCK * wide);
        for first in pixels.clone().step_by(BLOCK) {
            let range = first..(first + BLOCK).min(pixels.end);
            let count = range.len();
            if self.by_output {
                x.copy(isa, range.clone(), &mut a, tall);
                dy.gather(isa, grid, range, true, &mut b, wide);
            } else {
                x.gather(isa, grid, range.clone(), false, &mut a, tall);
                dy.copy(isa, range, &mut b, wide);
            }
            let products = Outer {
                a: &a,
                a_step: tall,
                rows: self.rows + 1,
                b: &b,
                b_step: wide,
                columns: self.columns,
                pixels: count,
            };
            rows::add_outer(isa, products, sum, wide);
        }
    }
}
