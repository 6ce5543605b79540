//! Tiles of maps, and their places in the transformed space.

use std::ops::Range;

use super::line::{self, both, each};
use crate::Grid;
use crate::conv3x3::parts::GatedMap;
use crate::simd::Simd;

#[derive(Clone, Copy)]
pub(super) struct WinogradTiles {
    pub(super) grid: Grid,
    /// Grid of the input, with more rows where the output is a band of an image.
    pub(super) input: Grid,
    /// Rows of the input above the first row of the output.
    pub(super) above: usize,
    pub(super) out: usize,
    pub(super) down: usize,
    pub(super) across: usize,
}

impl WinogradTiles {
    pub(super) fn new(grid: Grid, out: usize) -> Self {
        WinogradTiles::of_rows(grid, 0, grid.height, out)
    }

    /// The tiles of `height` rows from `above` on.
    pub(super) fn of_rows(input: Grid, above: usize, height: usize, out: usize) -> Self {
        let grid = Grid { height, ..input };
        let (down, across) = (height.div_ceil(out), grid.width.div_ceil(out));
        WinogradTiles {
            grid,
            input,
            above,
            out,
            down,
            across,
        }
    }

    pub(super) fn count(self) -> usize {
        self.grid.batch * self.down * self.across
    }

    /// First pixel of the image, and row and column of a tile's output.
    pub(super) fn at(self, tile: usize) -> (usize, usize, usize) {
        let (image, rest) = (
            tile / (self.down * self.across),
            tile % (self.down * self.across),
        );
        let first = image * self.grid.height * self.grid.width;
        (
            first,
            rest / self.across * self.out,
            rest % self.across * self.out,
        )
    }

    /// First pixel of the input image, and row and column of a tile's input, which starts one row
    /// and one column before its output.
    pub(super) fn input_at(self, tile: usize) -> (usize, isize, isize) {
        let (_, row, column) = self.at(tile);
        let first = tile / (self.down * self.across) * self.input.height * self.input.width;
        (first, (row + self.above) as isize - 1, column as isize - 1)
    }
}

impl GatedMap<'_> {
    /// The `size x size` pixels of a tile from `(row, column)` of the image at `image`; zeros
    /// outside the image.
    ///
    /// # Safety
    /// The machine has the path of `S`.
    #[inline(always)]
    pub(super) unsafe fn tile<S: Simd, const IN: usize, const SIZE: usize>(
        &self,
        grid: Grid,
        image: usize,
        row: isize,
        column: isize,
        channel: usize,
    ) -> [[S::V; IN]; IN] {
        let n = S::LANES.min(self.channels - channel);
        let inside = row >= 0
            && column >= 0
            && row as usize + SIZE <= grid.height
            && column as usize + SIZE <= grid.width;
        // SAFETY: only pixels of the image are loaded, `n` channels of which are there.
        unsafe {
            let mut d = [[S::zero(); IN]; IN];
            if inside && n == S::LANES {
                let first =
                    (image + row as usize * grid.width + column as usize) * self.channels + channel;
                let line = grid.width * self.channels;
                let map = self.map.as_ptr().add(first);
                match self.gate {
                    None => each!(r < SIZE, {
                        let map = map.add(r * line);
                        each!(c < SIZE, {
                            d[r][c] = S::load(map.add(c * self.channels));
                        });
                    }),
                    Some(gate) => {
                        let gate = gate.as_ptr().add(first);
                        each!(r < SIZE, {
                            let (map, gate) = (map.add(r * line), gate.add(r * line));
                            each!(c < SIZE, {
                                let offset = c * self.channels;
                                d[r][c] =
                                    S::gate(S::load(map.add(offset)), S::load(gate.add(offset)));
                            });
                        });
                    }
                }
            } else {
                #[allow(clippy::needless_range_loop, reason = "two arrays' worth of indices")]
                for r in 0..SIZE {
                    for c in 0..SIZE {
                        let (y, x) = (row + r as isize, column + c as isize);
                        let inside = y >= 0
                            && x >= 0
                            && (y as usize) < grid.height
                            && (x as usize) < grid.width;
                        if inside {
                            let pixel = image + y as usize * grid.width + x as usize;
                            let offset = pixel * self.channels + channel;
                            let value = S::load_part(self.map.as_ptr().add(offset), n);
                            d[r][c] = match self.gate {
                                None => value,
                                Some(gate) => {
                                    S::gate(value, S::load_part(gate.as_ptr().add(offset), n))
                                }
                            };
                        }
                    }
                }
            }
            d
        }
    }
}

/// Transformed tiles of a map: `[place][tile][channel]`.
#[derive(Clone, Copy)]
pub(super) struct TransformedTiles {
    pub(super) start: *mut f32,
    pub(super) place_step: usize,
    pub(super) tile_step: usize,
}

impl TransformedTiles {
    /// Stores one vector of channels of a tile.
    ///
    /// # Safety
    /// The machine has the path of `S`, and the tile is the caller's to write.
    #[inline(always)]
    pub(super) unsafe fn store<S: Simd, const IN: usize>(
        self,
        tile: usize,
        channel: usize,
        v: [[S::V; IN]; IN],
    ) {
        // SAFETY: guaranteed by the caller.
        unsafe {
            let target = self.start.add(tile * self.tile_step + channel);
            each!(r < IN, {
                let target = target.add(r * IN * self.place_step);
                each!(c < IN, {
                    S::store(target.add(c * self.place_step), v[r][c]);
                });
            });
        }
    }

    /// Loads one vector of channels of a tile.
    ///
    /// # Safety
    /// As for [`store`](Self::store), for reading.
    #[inline(always)]
    pub(super) unsafe fn load<S: Simd, const IN: usize>(
        self,
        tile: usize,
        channel: usize,
    ) -> [[S::V; IN]; IN] {
        // SAFETY: guaranteed by the caller.
        unsafe {
            let from = self.start.add(tile * self.tile_step + channel);
            let mut v = [[S::zero(); IN]; IN];
            each!(r < IN, {
                let from = from.add(r * IN * self.place_step);
                each!(c < IN, {
                    v[r][c] = S::load(from.add(c * self.place_step));
                });
            });
            v
        }
    }
}

/// `B^T x B` of some tiles.
///
/// # Safety
/// The machine has the path of `S`, and the tiles from `target` on are the caller's to write.
#[inline(always)]
pub(super) unsafe fn take_input<S: Simd, const IN: usize>(
    source: GatedMap,
    tiles: WinogradTiles,
    range: Range<usize>,
    target: TransformedTiles,
) {
    for (index, tile) in range.enumerate() {
        let (image, row, column) = tiles.input_at(tile);
        for channel in (0..source.channels).step_by(S::LANES) {
            // SAFETY: guaranteed by the caller.
            unsafe {
                let d = source.tile::<S, IN, IN>(tiles.input, image, row, column, channel);
                let v = both!(line::input::<S, IN>, S, IN, d);
                target.store::<S, IN>(index, channel, v);
            }
        }
    }
}
