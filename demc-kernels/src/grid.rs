//! The size of a batch of maps, and the conversion between channels first and channels last.

use crate::Isa;
use crate::scratch::Shared;
use crate::simd::{self, Leaf, Simd};
use crate::tasks;

/// Number of images and their size. A map on a grid has `pixels() * channels` values, channels
/// last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Grid {
    /// Images.
    pub batch: usize,
    /// Rows of an image, px.
    pub height: usize,
    /// Columns of an image, px.
    pub width: usize,
}

impl Grid {
    /// Pixels of all images together.
    pub fn pixels(self) -> usize {
        self.batch * self.height * self.width
    }

    /// The grid after a 2x2 pooling. An odd last row or column is dropped.
    pub fn halved(self) -> Self {
        Grid {
            height: self.height / 2,
            width: self.width / 2,
            ..self
        }
    }

    /// The grid after a deconvolution with stride 2.
    pub fn doubled(self) -> Self {
        Grid {
            height: self.height * 2,
            width: self.width * 2,
            ..self
        }
    }

    /// Channels of a map of `len` values.
    ///
    /// # Panics
    /// If `len` is not a multiple of the pixels.
    pub fn channels(self, len: usize) -> usize {
        let pixels = self.pixels();
        assert!(
            pixels > 0 && len.is_multiple_of(pixels),
            "{len} values are no map on {self:?}"
        );
        len / pixels
    }
}

/// Converts channels first to channels last.
///
/// # Panics
/// If a length does not match the others.
pub fn nhwc_from_nchw(grid: Grid, x: &[f32], y: &mut [f32]) {
    assert_eq!(x.len(), y.len(), "maps of one size");
    let (channels, plane) = (grid.channels(x.len()), grid.height * grid.width);
    each_pixels(grid, channels, x, y, |x, y, first, pixels| {
        let (x, y) = (x.wrapping_add(first), y.wrapping_add(first * channels));
        Transpose {
            x,
            row: plane,
            y,
            column: channels,
            rows: channels,
            columns: pixels,
        }
    });
}

/// Converts channels last to channels first.
///
/// # Panics
/// If a length does not match the others.
pub fn nchw_from_nhwc(grid: Grid, x: &[f32], y: &mut [f32]) {
    assert_eq!(x.len(), y.len(), "maps of one size");
    let (channels, plane) = (grid.channels(x.len()), grid.height * grid.width);
    each_pixels(grid, channels, x, y, |x, y, first, pixels| {
        let (x, y) = (x.wrapping_add(first * channels), y.wrapping_add(first));
        Transpose {
            x,
            row: channels,
            y,
            column: plane,
            rows: pixels,
            columns: channels,
        }
    });
}

/// Transposes the pieces of each image. `piece` builds the transposition from pointers to the image
/// in `x` and `y`, the first pixel and the number of pixels.
fn each_pixels(
    grid: Grid,
    channels: usize,
    x: &[f32],
    y: &mut [f32],
    piece: impl Fn(*const f32, *mut f32, usize, usize) -> Transpose + Send + Sync,
) {
    let plane = grid.height * grid.width;
    let step = tasks::rows_per_task(channels).next_multiple_of(64);
    let starts = (0..plane).step_by(step);
    let pieces = (0..grid.batch).flat_map(|image| starts.clone().map(move |first| (image, first)));
    let target = Shared::new(y);
    tasks::each(pieces, |(image, first)| {
        let offset = image * plane * channels;
        let (x, y) = (x[offset..].as_ptr(), target.offset(offset).pointer());
        let leaf = piece(x, y, first, step.min(plane - first));
        // SAFETY: the piece's pixels of all channels lie inside `x` and `y`, and no other piece has
        // them.
        unsafe { simd::run(tasks::streaming(Isa::current()), leaf) }
    });
}

/// `y[j * column + i] = x[i * row + j]` for i below `rows` and j below `columns`.
struct Transpose {
    x: *const f32,
    row: usize,
    y: *mut f32,
    column: usize,
    rows: usize,
    columns: usize,
}

/// Minimum number of rows and columns of a tile that is moved by vectors.
const NARROW: usize = 4;

impl Leaf for Transpose {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        // Tiles have the length of a vector in both directions. The shorter side varies fastest, so
        // that whole cache lines are written.
        let (high, wide) = (
            self.rows.div_ceil(S::LANES),
            self.columns.div_ceil(S::LANES),
        );
        for t in 0..high * wide {
            let (i, j) = if high > wide {
                (t % high, t / high)
            } else {
                (t / wide, t % wide)
            };
            let (i, j) = (i * S::LANES, j * S::LANES);
            let rows = S::LANES.min(self.rows - i);
            let columns = S::LANES.min(self.columns - j);
            // SAFETY: the tile lies inside.
            unsafe {
                let (x, y) = (
                    self.x.add(i * self.row + j),
                    self.y.add(j * self.column + i),
                );
                if rows == S::LANES && columns == S::LANES {
                    self.whole_tile::<S>(x, y);
                } else if rows >= NARROW && columns >= NARROW {
                    self.part_of_tile::<S>(x, y, rows, columns);
                } else {
                    for (i, j) in (0..rows).flat_map(|i| (0..columns).map(move |j| (i, j))) {
                        *y.add(j * self.column + i) = *x.add(i * self.row + j);
                    }
                }
            }
        }
    }
}

impl Transpose {
    /// # Safety
    /// `x` is readable and `y` writable for LANES rows and columns.
    #[inline(always)]
    unsafe fn whole_tile<S: Simd>(&self, x: *const f32, y: *mut f32) {
        // SAFETY: guaranteed by the caller.
        unsafe {
            let mut tile = [S::zero(); MOST_LANES];
            for (i, v) in tile[..S::LANES].iter_mut().enumerate() {
                *v = S::load(x.add(i * self.row));
            }
            let tile = transposed::<S>(tile);
            for (j, v) in tile[..S::LANES].iter().enumerate() {
                S::store(y.add(j * self.column), *v);
            }
        }
    }

    /// # Safety
    /// `x` is readable and `y` writable for these rows and columns, at most LANES.
    #[inline(always)]
    unsafe fn part_of_tile<S: Simd>(
        &self,
        x: *const f32,
        y: *mut f32,
        rows: usize,
        columns: usize,
    ) {
        // SAFETY: guaranteed by the caller.
        unsafe {
            let mut tile = [S::zero(); MOST_LANES];
            for (i, v) in tile[..rows].iter_mut().enumerate() {
                *v = S::load_part(x.add(i * self.row), columns);
            }
            let tile = transposed::<S>(tile);
            for (j, v) in tile[..columns].iter().enumerate() {
                S::store_part(y.add(j * self.column), rows, *v);
            }
        }
    }
}

/// Lanes of the widest vectors.
const MOST_LANES: usize = 16;

/// Transposes the first LANES vectors: each round interleaves the first half of the rows with the
/// second.
///
/// # Safety
/// The machine has the path of `S`.
#[inline(always)]
unsafe fn transposed<S: Simd>(mut tile: [S::V; MOST_LANES]) -> [S::V; MOST_LANES] {
    for _ in 0..S::LANES.ilog2() {
        let from = tile;
        for i in 0..S::LANES / 2 {
            // SAFETY: guaranteed by the caller.
            [tile[2 * i], tile[2 * i + 1]] =
                unsafe { S::interleave(from[i], from[i + S::LANES / 2]) };
        }
    }
    tile
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{grids, pattern};

    /// Tests, on every path, the leaf that both directions share.
    #[test]
    fn a_transposed_matrix_has_its_rows_for_columns() {
        for (rows, columns) in [
            (1, 1),
            (3, 40),
            (16, 16),
            (8, 33),
            (17, 6),
            (64, 20),
            (5, 5),
            (12, 100),
        ] {
            let x = pattern(rows * columns, 1);
            for isa in Isa::available() {
                let mut found = vec![f32::NAN; x.len()];
                let (x, y) = (x.as_ptr(), found.as_mut_ptr());
                let leaf = Transpose {
                    x,
                    row: columns,
                    y,
                    column: rows,
                    rows,
                    columns,
                };
                // SAFETY: both have rows * columns values.
                unsafe { simd::run(isa, leaf) }
                for (offset, y) in found.iter().enumerate() {
                    // SAFETY: as above.
                    let expected = unsafe { *x.add(offset % rows * columns + offset / rows) };
                    assert!(*y == expected, "{isa}: {rows} x {columns} at {offset}");
                }
            }
        }
    }

    #[test]
    fn channels_go_last_and_come_back() {
        let large = Grid {
            batch: 2,
            height: 60,
            width: 61,
        };
        let grids = grids().into_iter().chain((!cfg!(miri)).then_some(large));
        for grid in grids {
            for channels in [1, 3, 12, 17, 64] {
                let x = pattern(grid.pixels() * channels, 2);
                let (mut last, mut first) = (vec![f32::NAN; x.len()], vec![f32::NAN; x.len()]);
                nhwc_from_nchw(grid, &x, &mut last);
                let plane = grid.height * grid.width;
                for (i, value) in last.iter().enumerate() {
                    let (pixel, c) = (i / channels, i % channels);
                    let offset = (pixel / plane * channels + c) * plane + pixel % plane;
                    assert!(*value == x[offset], "{grid:?} of {channels}");
                }
                nchw_from_nhwc(grid, &last, &mut first);
                assert!(first == x, "{grid:?} of {channels}");
            }
        }
    }
}
