//! 3x3 convolutions with few channels on one side (the first and the last of the network), as plain sums.
//!
//! Few inputs: the 3x3 neighbourhood of a pixel becomes a row of `9 * in` values (*im2col*), and the convolution one
//! product. Few outputs would leave most lanes of a vector empty; there the product makes all `9 * out` values that a
//! pixel gives to its neighbours, which are then collected (*col2im*).

mod collect;
mod gather;

use rayon::prelude::*;

use super::parts::{Axes, Finish, Source};
use crate::product::padded_rows;
use crate::rows::{self, BLOCK, Copy, Outer, Packed, Term, copy, whole};
use crate::scratch::Scratch;
use crate::{Grid, Isa};
use collect::collect;

/// Most values that all taps of the outputs together may have for collecting to pay.
const MOST_COLLECTED: usize = 36;

/// `y = finish(weight * x)`, `x` gated where a gate is given, of the rows from `above` on, as many as `y` has; `grid` is
/// that of `x`.
///
/// # Panics
/// Where there are several images and `y` does not have all their rows.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub(crate) fn convolve(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    gate: Option<&[f32]>,
    above: usize,
    weight: &[f32],
    axes: Axes,
    finish: Finish,
    y: &mut [f32],
) {
    let source = Source {
        map: x,
        gate,
        channels: axes.inputs,
    };
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
        collect(isa, grid, source, above, weight, axes, finish, y);
    } else {
        spread(isa, grid, source, above, weight, axes, finish, y);
    }
}

/// By rows of neighbourhoods.
#[allow(clippy::too_many_arguments, reason = "as `convolve`")]
fn spread(
    isa: Isa,
    grid: Grid,
    source: Source,
    above: usize,
    weight: &[f32],
    axes: Axes,
    finish: Finish,
    y: &mut [f32],
) {
    let (depth, columns) = (9 * axes.inputs, axes.outputs);
    let b = Packed::new(isa, depth, columns, |k, column| {
        weight[axes.place(k % axes.inputs, column, k / axes.inputs)]
    });
    let wide = whole(columns);
    y.par_chunks_mut(BLOCK * columns)
        .enumerate()
        .for_each(|(task, y)| {
            let (first, count) = (task * BLOCK, y.len() / columns);
            let mut a = Scratch::take(padded_rows(count) * depth);
            let mut c = Scratch::take(padded_rows(count) * wide);
            let skipped = above * grid.width;
            source.gather(
                isa,
                grid,
                skipped + first..skipped + first + count,
                false,
                &mut a,
                depth,
            );
            rows::sum(
                isa,
                count,
                &[Term {
                    rows: &a,
                    step: depth,
                    weight: &b,
                }],
                &mut c,
                wide,
            );
            copy(
                isa,
                Copy {
                    from: &c,
                    from_step: wide,
                    gate: None,
                    bias: finish.bias,
                    relu: finish.relu,
                    to: y,
                    to_step: columns,
                    rows: count,
                    channels: columns,
                },
            );
        });
}

/// Stretches that the pixels are cut into for a gradient: each is summed by one task, and the sums are added in order.
const STRETCHES: usize = 16;

/// Gradient by the weight `[out, in, 3, 3]` and by the bias, `dy` gated where a gate is given.
pub(crate) fn gradient(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    dy: &[f32],
    gate: Option<&[f32]>,
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
    let (inputs, outputs) = (grid.channels(x.len()), dbias.len());
    let x = Source {
        map: x,
        gate: None,
        channels: inputs,
    };
    let dy = Source {
        map: dy,
        gate,
        channels: outputs,
    };
    // The thin side is the one whose neighbourhoods become rows.
    let by_output = 9 * outputs <= MOST_COLLECTED && inputs > outputs;
    let (rows, columns) = if by_output {
        (inputs, 9 * outputs)
    } else {
        (9 * inputs, outputs)
    };
    // One row more, of ones: its gradient is the sum of `dy`, the bias's.
    let (tall, wide) = (padded_rows(rows + 1), whole(columns));
    let pixels = grid.pixels();
    let stretch = pixels.div_ceil(STRETCHES).next_multiple_of(BLOCK);
    let stretches = pixels.div_ceil(stretch);
    let size = tall * wide;
    let mut sums = Scratch::zeroed(stretches * size);
    sums.par_chunks_mut(size)
        .enumerate()
        .for_each(|(index, sum)| {
            let end = ((index + 1) * stretch).min(pixels);
            let mut a = Scratch::zeroed(BLOCK * tall);
            a.iter_mut()
                .skip(rows)
                .step_by(tall)
                .for_each(|one| *one = 1.0);
            let mut b = Scratch::zeroed(BLOCK * wide);
            for first in (index * stretch..end).step_by(BLOCK) {
                let range = first..(first + BLOCK).min(end);
                let count = range.len();
                if by_output {
                    x.copy(isa, range.clone(), &mut a, tall);
                    dy.gather(isa, grid, range, true, &mut b, wide);
                } else {
                    x.gather(isa, grid, range.clone(), false, &mut a, tall);
                    dy.copy(isa, range, &mut b, wide);
                }
                let products = Outer {
                    a: &a,
                    a_step: tall,
                    rows: rows + 1,
                    b: &b,
                    b_step: wide,
                    columns,
                    pixels: count,
                };
                rows::add_outer(isa, products, sum, wide);
            }
        });
    let total = |row: usize, column: usize| -> f32 {
        (0..stretches)
            .map(|s| sums[s * size + row * wide + column])
            .sum()
    };
    for o in 0..outputs {
        for i in 0..inputs {
            for tap in 0..9 {
                dweight[(o * inputs + i) * 9 + tap] = match by_output {
                    true => total(i, tap * outputs + o),
                    false => total(tap * inputs + i, o),
                };
            }
        }
        // Among the neighbourhoods of `dy` the middle tap is `dy` itself.
        dbias[o] = total(rows, if by_output { 4 * outputs + o } else { o });
    }
}
