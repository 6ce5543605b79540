//! The gradient with respect to the weight: products with a reduction over tiles.

use std::ops::Range;

use rayon::prelude::*;

use super::line::{self, both, each};
use super::tiles::{TransformedTiles, WinogradTiles, take_input};
use super::weights::{padded, place_step};
use crate::conv3x3::parts::{Axes, GatedMap};
use crate::product::{Left, Right, Size, Target, padded_rows, product};
use crate::scratch::{Scratch, Shared};
use crate::simd::{Leaf, Simd, WIDEST, run};
use crate::{Grid, Isa};

/// Transforms some tiles for the gradient of the weight: `B^T x B`, `A dy A^T`, and the sum of
/// `dy`.
struct TransformTiles<'a, const IN: usize> {
    x: GatedMap<'a>,
    dy: GatedMap<'a>,
    tiles: WinogradTiles,
    range: Range<usize>,
    /// Index of the first tile within the buffers.
    index: usize,
    v: (Shared, usize, usize),
    z: (Shared, usize, usize),
    /// Sum of `dy` over the tiles, whole vectors.
    dbias: Shared,
}

impl<const IN: usize> Leaf for TransformTiles<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let space = |(start, place_step, tile_step): (Shared, usize, usize)| TransformedTiles {
            // The tiles from `index` on.
            start: start.pointer().wrapping_add(self.index * tile_step),
            place_step,
            tile_step,
        };
        let (v, z) = (space(self.v), space(self.z));
        // SAFETY: tiles from `index` on are this leaf's; `dbias` holds whole vectors, this leaf's
        // too.
        unsafe {
            take_input::<S, IN>(self.x, self.tiles, self.range.clone(), v);
            for channel in (0..self.dy.channels).step_by(S::LANES) {
                S::store(self.dbias.pointer().add(channel), S::zero());
            }
            for (index, tile) in self.range.enumerate() {
                let (image, row, column) = self.tiles.at(tile);
                let (row, column) = (row as isize, column as isize);
                for channel in (0..self.dy.channels).step_by(S::LANES) {
                    let d = match IN {
                        4 => self
                            .dy
                            .tile::<S, IN, 2>(self.tiles.grid, image, row, column, channel),
                        _ => self
                            .dy
                            .tile::<S, IN, 4>(self.tiles.grid, image, row, column, channel),
                    };
                    let target = self.dbias.pointer().add(channel);
                    let mut sum = S::load(target);
                    each!(r < IN - 2, {
                        each!(c < IN - 2, {
                            sum = S::add(sum, d[r][c]);
                        });
                    });
                    S::store(target, sum);
                    let m = both!(line::output_transposed::<S, IN>, S, IN, d);
                    z.store::<S, IN>(index, channel, m);
                }
            }
        }
    }
}

/// Adds the products of a chunk of tiles to some rows of a place of the gradient.
struct Accumulate {
    rows: usize,
    depth: usize,
    columns: usize,
    a: Shared,
    a_step: usize,
    b: Shared,
    b_step: usize,
    c: Shared,
    c_step: usize,
}

impl Leaf for Accumulate {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        // SAFETY: the caller's: buffers with the padding that a product asks for.
        unsafe {
            let a = Left {
                start: self.a.pointer(),
                row_step: 1,
                k_step: self.a_step,
            };
            let b = Right::Rows {
                start: self.b.pointer(),
                step: self.b_step,
            };
            let size = Size {
                rows: self.rows,
                depth: self.depth,
                columns: self.columns,
            };
            let c = Target {
                start: self.c.pointer(),
                step: self.c_step,
                accumulate: true,
            };
            product::<S>(size, a, b, c);
        }
    }
}

/// Transforms some rows (inputs) of the gradient back to `[out, in, 3, 3]`.
struct Unpack<'a, const IN: usize> {
    gradient: &'a [f32],
    place_step: usize,
    row_step: usize,
    axes: Axes,
    rows: Range<usize>,
    target: Shared,
}

impl<const IN: usize> Leaf for Unpack<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        for k in self.rows {
            for first in (0..self.axes.outputs).step_by(S::LANES) {
                let mut taps = [[0.0; WIDEST]; 9];
                // SAFETY: places hold whole vectors; the weights of these rows are this leaf's.
                unsafe {
                    let mut u = [[S::zero(); IN]; IN];
                    let from = self.gradient.as_ptr().add(k * self.row_step + first);
                    for place in 0..IN * IN {
                        u[place / IN][place % IN] = S::load(from.add(place * self.place_step));
                    }
                    let w = both!(line::weight_transposed::<S, IN>, S, IN, u);
                    for (tap, lanes) in taps.iter_mut().enumerate() {
                        S::store(lanes.as_mut_ptr(), w[tap / 3][tap % 3]);
                    }
                    for lane in 0..S::LANES.min(self.axes.outputs - first) {
                        for (tap, lanes) in taps.iter().enumerate() {
                            *self
                                .target
                                .pointer()
                                .add(self.axes.place(k, first + lane, tap)) = lanes[lane];
                        }
                    }
                }
            }
        }
    }
}

/// Values of both buffers of a chunk of tiles in [`gradient`].
const CHUNK_VALUES: usize = 1 << 20;

/// Tiles that one task transforms in [`gradient`]; the bias is summed over the same stretches.
const TASK_TILES: usize = 32;

/// Gradients with respect to the weight `[out, in, 3, 3]` and the bias.
pub(crate) fn gradient<const IN: usize>(
    isa: Isa,
    grid: Grid,
    x: GatedMap,
    dy: GatedMap,
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
    let (inputs, outputs) = (x.channels, dy.channels);
    assert_eq!(
        dweight.len(),
        outputs * inputs * 9,
        "a weight of {inputs} to {outputs} channels"
    );
    assert_eq!(dbias.len(), outputs, "a bias of {outputs} channels");
    assert!(
        dy.gate.is_none_or(|gate| gate.len() == dy.map.len()),
        "the gate of a map of {} values",
        dy.map.len()
    );
    let (u, sums) = transformed_gradient::<IN>(isa, WinogradTiles::new(grid, IN - 2), x, dy);
    let wide = padded(isa, outputs);
    for (o, dbias) in dbias.iter_mut().enumerate() {
        let sum: f64 = sums[o..].iter().step_by(wide).map(|x| f64::from(*x)).sum();
        *dbias = sum as f32;
    }
    let axes = Axes::new(outputs, inputs, false);
    let target = Shared::new(dweight);
    let step = (8192 / outputs).max(1);
    (0..inputs.div_ceil(step)).into_par_iter().for_each(|task| {
        let leaf = Unpack::<IN> {
            gradient: &u,
            place_step: place_step(padded_rows(inputs) * wide),
            row_step: wide,
            axes,
            rows: task * step..((task + 1) * step).min(inputs),
            target,
        };
        // SAFETY: tasks write the weights of different inputs.
        unsafe { run(isa, leaf) }
    });
}

/// The gradient of the transformed weight, `IN * IN` places of `[in, out]` with padding, and the sums
/// of `dy` over stretches of [`TASK_TILES`] tiles, `[stretches, out]` with padding.
fn transformed_gradient<const IN: usize>(
    isa: Isa,
    tiles: WinogradTiles,
    x: GatedMap,
    dy: GatedMap,
) -> (Scratch, Scratch) {
    let (inputs, outputs) = (x.channels, dy.channels);
    let (tall, wide) = (padded(isa, inputs), padded(isa, outputs));
    let chunk = (CHUNK_VALUES / (IN * IN * (tall + wide)))
        .next_multiple_of(TASK_TILES)
        .max(TASK_TILES)
        .min(tiles.count().next_multiple_of(TASK_TILES));
    let (v_step, z_step) = (place_step(chunk * tall + 32), place_step(chunk * wide));
    let mut v = Scratch::take(IN * IN * v_step);
    let mut z = Scratch::take(IN * IN * z_step);
    let rows = padded_rows(inputs);
    let u_step = place_step(rows * wide);
    let mut u = Scratch::zeroed(IN * IN * u_step);
    let mut sums = Scratch::take(tiles.count().div_ceil(TASK_TILES) * wide);
    let (v, z, u_shared, sums_shared) = (
        Shared::new(&mut v),
        Shared::new(&mut z),
        Shared::new(&mut u),
        Shared::new(&mut sums),
    );
    // Gradient rows per task: whole row blocks, so that no two tasks write the same row.
    let row_task = if rows >= 96 { 48 } else { rows };
    let row_tasks = rows.div_ceil(row_task);
    for first in (0..tiles.count()).step_by(chunk) {
        let count = chunk.min(tiles.count() - first);
        (0..count.div_ceil(TASK_TILES))
            .into_par_iter()
            .for_each(|task| {
                let index = task * TASK_TILES;
                let leaf = TransformTiles::<IN> {
                    x,
                    dy,
                    tiles,
                    range: first + index..first + (index + TASK_TILES).min(count),
                    index,
                    v: (v, v_step, tall),
                    z: (z, z_step, wide),
                    dbias: sums_shared.offset(((first + index) / TASK_TILES) * wide),
                };
                // SAFETY: every tile of the chunk and every stretch of `sums` is written by one
                // task.
                unsafe { run(isa, leaf) }
            });
        (0..IN * IN * row_tasks).into_par_iter().for_each(|task| {
            let (place, row) = (task / row_tasks, task % row_tasks * row_task);
            let leaf = Accumulate {
                rows: row_task.min(inputs.saturating_sub(row)),
                depth: count,
                columns: outputs,
                a: v.offset(place * v_step + row),
                a_step: tall,
                b: z.offset(place * z_step),
                b_step: wide,
                c: u_shared.offset(place * u_step + row * wide),
                c_step: wide,
            };
            // SAFETY: every row of every place of `u` is written by one task. `v` has 32 values
            // beyond its last row, and the rows of `u` are padded.
            unsafe { run(isa, leaf) }
        });
    }
    (u, sums)
}
