//! 3x3 convolutions with fewer multiplications (Winograd 1980; Lavin and Gray 2016).
//!
//! An output tile of `OUT x OUT` pixels needs an input tile of `IN x IN`, `IN = OUT + 2`. Both are
//! transformed to a space of `IN x IN` *places*. There the convolution is one matrix product per
//! place, `tiles x in` times `in x out`: `Y = A^T [ (G w G^T) * (B^T x B) ] A`.
//!
//! F(2x2, 3x3) needs 2.25 times fewer multiplications than the plain sum and is as exact. F(4x4,
//! 3x3) needs 4 times fewer and loses about one digit.
//!
//! With channels last, all three transforms work on vectors of channels without shuffles.

mod gradient;
mod line;
mod tiles;
mod weights;

use std::ops::Range;

use rayon::prelude::*;

use super::parts::{BiasRelu, GatedMap};
use crate::Grid;
use crate::product::{Left, Right, Size, Target, padded_rows, product};
use crate::scratch::{Scratch, Shared};
use crate::simd::{Leaf, Simd, run};
use line::{both, each};
use tiles::{TransformedTiles, WinogradTiles, take_input};
use weights::place_step;

pub(super) use gradient::gradient;
pub(super) use weights::WinogradWeights;

struct TileBlock<'a, const IN: usize> {
    source: GatedMap<'a>,
    weights: &'a WinogradWeights,
    epilogue: BiasRelu<'a>,
    tiles: WinogradTiles,
    range: Range<usize>,
    y: Shared,
}

impl<const IN: usize> Leaf for TileBlock<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let TileBlock {
            source,
            weights,
            epilogue,
            tiles,
            range,
            y,
        } = self;
        let (depth, columns) = (weights.depth, weights.columns);
        let target = OutputTiles {
            tiles,
            columns,
            epilogue,
            y,
        };
        let (count, rows) = (range.len(), padded_rows(range.len()));
        let space = |scratch: &mut Scratch, channels: usize| TransformedTiles {
            start: scratch.as_mut_ptr(),
            place_step: place_step(rows * channels),
            tile_step: channels,
        };
        let (wide, tall) = (
            columns.next_multiple_of(S::LANES),
            depth.next_multiple_of(S::LANES),
        );
        let mut input = Scratch::take(IN * IN * place_step(rows * tall));
        let mut output = Scratch::take(IN * IN * place_step(rows * wide));
        let (v, m) = (space(&mut input, tall), space(&mut output, wide));
        // SAFETY: the scratch buffers hold `rows` tiles a place; the tiles of `range` are this
        // leaf's to write in `y`.
        unsafe {
            take_input::<S, IN>(source, tiles, range.clone(), v);
            for place in 0..IN * IN {
                let a = Left {
                    start: v.start.add(place * v.place_step),
                    row_step: tall,
                    k_step: 1,
                };
                let b = Right::Packed(weights.values.as_ptr().add(place * weights.place_step));
                let size = Size {
                    rows: count,
                    depth,
                    columns,
                };
                let c = Target {
                    start: m.start.add(place * m.place_step),
                    step: wide,
                    accumulate: false,
                };
                product::<S>(size, a, b, c);
            }
            for (index, tile) in range.enumerate() {
                for channel in (0..columns).step_by(S::LANES) {
                    let sums = both!(
                        line::output::<S, IN>,
                        S,
                        IN,
                        m.load::<S, IN>(index, channel)
                    );
                    target.store::<S, IN>(tile, channel, sums);
                }
            }
        }
    }
}

/// The output map, written tile by tile.
struct OutputTiles<'a> {
    tiles: WinogradTiles,
    columns: usize,
    epilogue: BiasRelu<'a>,
    y: Shared,
}

impl OutputTiles<'_> {
    /// Writes some channels of a tile, from `channel` on, after bias and ReLU. The first `IN - 2` rows
    /// and columns of `sums` count, as far as they lie in the image.
    ///
    /// # Safety
    /// No other thread writes this tile; the processor has `S`.
    #[inline(always)]
    unsafe fn store<S: Simd, const IN: usize>(
        &self,
        tile: usize,
        channel: usize,
        sums: [[S::V; IN]; IN],
    ) {
        let (grid, columns, out) = (self.tiles.grid, self.columns, IN - 2);
        let (image, row, column) = self.tiles.at(tile);
        let whole = row + out <= grid.height && column + out <= grid.width;
        let line = grid.width * columns;
        let n = S::LANES.min(columns - channel);
        let mut result = sums;
        // SAFETY: pixels of the tile within the image, `n` channels of each.
        unsafe {
            let target = self
                .y
                .pointer()
                .add((image + row * grid.width + column) * columns + channel);
            let bias = self.epilogue.bias::<S>(channel, n);
            each!(r < out, {
                each!(c < out, {
                    let value = S::add(result[r][c], bias);
                    result[r][c] = if self.epilogue.relu {
                        S::relu(value)
                    } else {
                        value
                    };
                });
            });
            if whole && n == S::LANES {
                each!(r < out, {
                    each!(c < out, {
                        S::store(target.add(r * line + c * columns), result[r][c]);
                    });
                });
                return;
            }
            for (r, result) in result[..out.min(grid.height - row)].iter().enumerate() {
                for (c, value) in result[..out.min(grid.width - column)].iter().enumerate() {
                    S::store_part(target.add(r * line + c * columns), n, *value);
                }
            }
        }
    }
}

/// Values of a block's two buffers that a second-level cache holds beside the weights of one place.
const BLOCK_VALUES: usize = 128 << 10;

/// Maximum number of tiles in a block.
const MOST_TILES: usize = 192;

/// Minimum number of tiles in a block. With fewer, loading the weights takes longer than using
/// them.
const FEWEST_TILES: usize = 48;

/// Tiles per block, chosen so that the number of blocks keeps all threads busy.
fn block_tiles(tiles: usize, values_per_tile: usize, weights: usize) -> usize {
    // If the weights exceed the second-level cache, more tiles use them while they are cached.
    let fewest = if weights > 4 * BLOCK_VALUES {
        MOST_TILES / 2
    } else {
        FEWEST_TILES
    };
    let limit = (BLOCK_VALUES / values_per_tile).clamp(fewest, MOST_TILES);
    let threads = rayon::current_num_threads();
    let blocks = tiles.div_ceil(limit).next_multiple_of(threads);
    tiles.div_ceil(blocks)
}

/// `y = epilogue(weights * source)`.
///
/// # Panics
/// If a length does not match its map.
pub(crate) fn convolve<const IN: usize>(
    grid: Grid,
    source: GatedMap,
    weights: &WinogradWeights,
    epilogue: BiasRelu,
    y: &mut [f32],
) {
    convolve_rows::<IN>(grid, source, 0, weights, epilogue, y);
}

/// As [`convolve`], for the rows from `above` on, as many as `y` has. `grid` is the grid of `source`.
///
/// # Panics
/// If a length does not match its map, or `source` lacks those rows.
pub(crate) fn convolve_rows<const IN: usize>(
    grid: Grid,
    source: GatedMap,
    above: usize,
    weights: &WinogradWeights,
    epilogue: BiasRelu,
    y: &mut [f32],
) {
    let (depth, columns) = (weights.depth, weights.columns);
    let height = y.len() / (grid.batch * grid.width * columns);
    assert_eq!(
        source.map.len(),
        grid.pixels() * depth,
        "a map of {depth} channels on {grid:?}"
    );
    assert_eq!(
        y.len(),
        grid.batch * height * grid.width * columns,
        "a map of {columns} channels on {grid:?}"
    );
    assert!(
        above + height <= grid.height,
        "rows {above} to {} of {grid:?}",
        above + height
    );
    assert!(
        source
            .gate
            .is_none_or(|gate| gate.len() == source.map.len()),
        "the gate of a map of {} values",
        source.map.len()
    );
    let tiles = WinogradTiles::of_rows(grid, above, height, IN - 2);
    let step = block_tiles(
        tiles.count(),
        IN * IN * (depth + columns),
        weights.values.len(),
    );
    let y = Shared::new(y);
    (0..tiles.count().div_ceil(step))
        .into_par_iter()
        .for_each(|task| {
            let range = task * step..((task + 1) * step).min(tiles.count());
            let leaf = TileBlock::<IN> {
                source,
                weights,
                epilogue,
                tiles,
                range,
                y,
            };
            // SAFETY: every tile of `y` is written by one task; `source` and the weights have the
            // lengths checked above.
            unsafe { run(weights.isa, leaf) }
        });
}
