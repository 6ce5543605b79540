//! Contributions of pixels to their neighbours, summed (*col2im*).

use rayon::prelude::*;

use super::gather::neighbour;
use crate::conv3x3::parts::{BiasRelu, ThinConvolution};
use crate::product::padded_rows;
use crate::rows::{self, BLOCK, Packed, Term, whole};
use crate::scratch::Scratch;
use crate::simd::{Leaf, Simd, run};
use crate::{Grid, Isa};

/// Convolves by the values that each pixel contributes to its neighbours.
pub(super) fn collect(
    isa: Isa,
    operands: ThinConvolution,
    above: usize,
    epilogue: BiasRelu,
    y: &mut [f32],
) {
    let ThinConvolution {
        grid,
        source,
        weight,
        axes,
    } = operands;
    let (depth, outputs) = (axes.inputs, axes.outputs);
    let columns = 9 * outputs;
    let b = Packed::new(isa, depth, columns, |k, column| {
        weight[axes.place(k, column % outputs, column / outputs)]
    });
    let wide = whole(columns);
    let image = grid.height * grid.width;
    // One image at a time, so that the contributions stay in a cache.
    let mut given = Scratch::take((image.next_multiple_of(BLOCK) + BLOCK) * wide);
    let rows = y.len() / grid.batch;
    for (index, y) in y.chunks_mut(rows).enumerate() {
        given
            .par_chunks_mut(BLOCK * wide)
            .take(image.div_ceil(BLOCK))
            .enumerate()
            .for_each(|(task, c)| {
                let first = task * BLOCK;
                let count = BLOCK.min(image - first);
                let mut a = Scratch::take(padded_rows(count) * depth);
                source.copy(
                    isa,
                    index * image + first..index * image + first + count,
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
                    c,
                    wide,
                );
            });
        y.par_chunks_mut(grid.width * outputs)
            .enumerate()
            .for_each(|(row, y)| {
                let leaf = Collect {
                    grid,
                    given: &given,
                    wide,
                    epilogue,
                    row: above + row,
                    outputs,
                    y,
                };
                // SAFETY: the leaf checks its lengths.
                unsafe { run(isa, leaf) }
            });
    }
}

/// Sums the contributions that a row of pixels receives from its neighbours.
struct Collect<'a> {
    grid: Grid,
    given: &'a [f32],
    wide: usize,
    epilogue: BiasRelu<'a>,
    row: usize,
    outputs: usize,
    y: &'a mut [f32],
}

impl Leaf for Collect<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Collect {
            grid,
            given,
            wide,
            epilogue,
            row,
            outputs,
            y,
        } = self;
        assert!(y.len() == grid.width * outputs && row < grid.height);
        assert!(given.len() >= grid.height * grid.width * wide && wide >= 9 * outputs);
        for (column, y) in y.chunks_exact_mut(outputs).enumerate() {
            let pixel = row * grid.width + column;
            for channel in (0..outputs).step_by(S::LANES) {
                let n = S::LANES.min(outputs - channel);
                // SAFETY: neighbours are pixels of the image, each with `9 * outputs` values.
                unsafe {
                    let mut sum = epilogue.bias::<S>(channel, n);
                    for tap in 0..9 {
                        if let Some(offset) = neighbour(grid, row, column, tap) {
                            let from =
                                pixel.wrapping_add_signed(offset) * wide + tap * outputs + channel;
                            sum = S::add(sum, S::load_part(given.as_ptr().add(from), n));
                        }
                    }
                    let value = if epilogue.relu { S::relu(sum) } else { sum };
                    S::store_part(y.as_mut_ptr().add(channel), n, value);
                }
            }
        }
    }
}
