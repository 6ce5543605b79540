//! Cuts an image into tiles that fit into memory and together give the result of the whole image.
//!
//! In the encoders and the decoder, an output pixel depends on inputs at most 188 px away; the
//! fusion sub-network adds 4 px. Each tile therefore has a halo of 192 px ([`EXACT_HALO`]), which
//! is cut off its output. Tiles start at multiples of 32, the network's grid. Then only the order
//! of some sums changes. The halo ends at the image's edge. A smaller halo is faster and
//! approximate.
//!
//! Tiles form a grid. Of all grids whose largest tile fits, [`Tiles::plan`] takes the one that
//! computes the fewest pixels.

use std::ops::Range;

use demc_data::image::exr::MAX_SIDE;
use demc_model::DOWNSAMPLING;

use crate::memory::TooLarge;

/// Width of the halo in pixels at which tiles equal the whole image: the reach of the receptive
/// field (`188 + 4`).
pub const EXACT_HALO: usize = 192;

/// Options for tiles. The default is exact, with as few tiles as memory allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tiling {
    /// Width of the halo in pixels, rounded up to a multiple of 32. Below [`EXACT_HALO`] the result
    /// is approximate.
    pub halo: usize,
    /// Longest side of a tile in pixels without its halo, at least 32, rounded down to a multiple
    /// of 32; `None`: as memory allows.
    pub side: Option<usize>,
    /// Bytes that a pass may use; `None`: the available memory.
    pub memory: Option<u64>,
}

impl Default for Tiling {
    fn default() -> Self {
        Self {
            halo: EXACT_HALO,
            side: None,
            memory: None,
        }
    }
}

impl Tiling {
    /// Whether the tiles give the result of the whole image.
    pub fn is_exact(&self) -> bool {
        self.halo >= EXACT_HALO
    }

    /// The same options with the exact halo.
    pub fn exact(&self) -> Self {
        Self {
            halo: EXACT_HALO,
            ..*self
        }
    }

    /// The halo, rounded up to the network's grid; at most an image's side.
    fn grid_halo(&self) -> usize {
        self.halo.min(MAX_SIDE).next_multiple_of(DOWNSAMPLING)
    }
}

/// The tiles of a padded image: every combination of a row and a column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tiles {
    /// Rows from top to bottom.
    pub rows: Vec<Span>,
    /// Columns from left to right.
    pub columns: Vec<Span>,
}

/// One tile's range on an axis, in pixels. Both ranges start and end on multiples of 32, or at the image's
/// end.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Span {
    /// The pixels that the tile outputs. The cores of an axis are adjacent.
    pub core: Range<usize>,
    /// The pixels that the tile takes as input: the core with its halo, inside the image.
    pub read: Range<usize>,
}

impl Tiles {
    /// The grid with the fewest computed pixels for a padded image of `height` x `width` pixels.
    ///
    /// `need` returns the bytes of a tile of a height and a width. No tile needs more than
    /// `available` bytes; `None` is no limit.
    ///
    /// # Errors
    /// The smallest tile does not fit.
    pub fn plan(
        (height, width): (usize, usize),
        tiling: &Tiling,
        need: impl Fn(usize, usize) -> u64,
        available: Option<u64>,
    ) -> Result<Self, TooLarge> {
        let halo = tiling.grid_halo();
        let fits = |rows: &AxisCut, columns: &AxisCut| {
            available.is_none_or(|bytes| need(rows.longest, columns.longest) <= bytes)
        };
        let axis = |length: usize| -> Vec<AxisCut> {
            let side = tiling.side.unwrap_or(length).max(DOWNSAMPLING);
            let blocks = length.div_ceil(DOWNSAMPLING);
            let fewest = blocks.div_ceil(side / DOWNSAMPLING);
            (fewest..=blocks)
                .map(|count| AxisCut::new(length, count, halo))
                .collect()
        };
        let (rows, columns) = (axis(height), axis(width));
        let fitting = rows.iter().filter_map(|rows| {
            // Columns finer than the first fit compute more.
            let columns = columns.iter().find(|columns| fits(rows, columns))?;
            Some((rows, columns))
        });
        let best = fitting.min_by_key(|(rows, columns)| rows.total * columns.total);
        let cut = |length: usize, axis: &AxisCut| spans(length, axis.count, halo).collect();
        best.map(|(rows, columns)| Self {
            rows: cut(height, rows),
            columns: cut(width, columns),
        })
        .ok_or_else(|| {
            let smallest = (2 * halo + DOWNSAMPLING).min(height.max(width));
            TooLarge {
                width,
                height,
                tile: smallest,
                needed: need(smallest.min(height), smallest.min(width)).div_ceil(1 << 20),
                available: available.unwrap_or(u64::MAX) >> 20,
            }
        })
    }

    /// The number of tiles.
    pub fn count(&self) -> usize {
        self.rows.len() * self.columns.len()
    }

    /// All tiles as pairs of a row and a column.
    pub fn iter(&self) -> impl Iterator<Item = (&Span, &Span)> {
        self.rows
            .iter()
            .flat_map(|row| self.columns.iter().map(move |column| (row, column)))
    }

    /// Height and width of the largest tile with its halo.
    pub fn largest(&self) -> (usize, usize) {
        (longest(&self.rows), longest(&self.columns))
    }

    /// Pixels of the padded image.
    pub fn image_pixels(&self) -> u64 {
        let end = |spans: &[Span]| spans.last().map_or(0, |span| span.core.end as u64);
        end(&self.rows) * end(&self.columns)
    }

    /// Pixels that the network computes, halos included.
    pub fn computed_pixels(&self) -> u64 {
        let total = |spans: &[Span]| spans.iter().map(|span| span.read.len() as u64).sum::<u64>();
        total(&self.rows) * total(&self.columns)
    }
}

/// What the plan must know about one cut of an axis.
struct AxisCut {
    /// Number of spans.
    count: usize,
    /// The longest span with its halo, pixels.
    longest: usize,
    /// All spans with their halos, pixels.
    total: u64,
}

impl AxisCut {
    fn new(length: usize, count: usize, halo: usize) -> Self {
        let lengths = || spans(length, count, halo).map(|span| span.read.len());
        Self {
            count,
            longest: lengths().max().unwrap_or(0),
            total: lengths().sum::<usize>() as u64,
        }
    }
}

/// Cuts an axis of `length` pixels into `count` spans of nearly equal length, at multiples of 32.
fn spans(length: usize, count: usize, halo: usize) -> impl Iterator<Item = Span> {
    let blocks = length.div_ceil(DOWNSAMPLING);
    let edge = move |i: usize| (i * blocks / count * DOWNSAMPLING).min(length);
    (0..count).map(move |i| Span {
        core: edge(i)..edge(i + 1),
        read: edge(i).saturating_sub(halo)..(edge(i + 1) + halo).min(length),
    })
}

fn longest(spans: &[Span]) -> usize {
    let lengths = spans.iter().map(|span| span.read.len());
    lengths.max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixels(height: usize, width: usize) -> u64 {
        (height * width) as u64
    }

    fn plan(size: (usize, usize), tiling: Tiling, available: u64) -> Result<Tiles, TooLarge> {
        Tiles::plan(size, &tiling, pixels, Some(available))
    }

    #[test]
    fn an_image_that_fits_is_one_tile() {
        let tiles = plan((736, 1280), Tiling::default(), 736 * 1280).expect("it fits");
        assert_eq!((tiles.count(), tiles.largest()), (1, (736, 1280)));
        assert_eq!(tiles.computed_pixels(), 736 * 1280);
    }

    /// Cores cover every pixel once. Halos are complete except at the image's edge. Every number is
    /// a multiple of 32. No tile exceeds the limit.
    #[test]
    fn tiles_cover_the_image_once_for_every_limit() {
        for (height, width) in [(32, 32), (736, 1280), (2176, 3840), (96, 8192)] {
            for available in [420 * 420, 700 * 700, 1500 * 900] {
                for halo in [0, 64, EXACT_HALO] {
                    let tiling = Tiling {
                        halo,
                        ..Tiling::default()
                    };
                    let tiles = plan((height, width), tiling, available).expect("416 x 416 fits");
                    let (rows, columns) = tiles.largest();
                    assert!((rows * columns) as u64 <= available);
                    for (spans, length) in [(&tiles.rows, height), (&tiles.columns, width)] {
                        let mut next = 0;
                        for Span { core, read } in spans {
                            assert_eq!(core.start, next);
                            assert!(!core.is_empty() && core.end % 32 == 0);
                            assert_eq!(read.start, core.start.saturating_sub(halo));
                            assert_eq!(read.end, (core.end + halo).min(length));
                            next = core.end;
                        }
                        assert_eq!(next, length);
                    }
                }
            }
        }
    }

    /// A U-Net's sides are multiples of 16.
    #[test]
    fn the_last_tile_may_end_between_two_blocks() {
        let (height, width) = (1088 + 16, 1920);
        let tiles = plan((height, width), Tiling::default(), 700 * 700).expect("416 x 416 fits");
        let last = tiles.rows.last().expect("a row");
        assert_eq!((last.core.end, last.read.end), (height, height));
        assert!(tiles.rows.iter().all(|span| span.core.start % 32 == 0));
        assert_eq!(tiles.image_pixels(), (height * width) as u64);
    }

    #[test]
    fn no_grid_that_fits_computes_less() {
        let (height, width, available) = (736, 1280, 900 * 700);
        let found = plan((height, width), Tiling::default(), available).expect("it fits");
        for rows in 1..=height / 32 {
            for columns in 1..=width / 32 {
                let other = Tiles {
                    rows: spans(height, rows, EXACT_HALO).collect(),
                    columns: spans(width, columns, EXACT_HALO).collect(),
                };
                let (tall, wide) = other.largest();
                let fits = (tall * wide) as u64 <= available;
                assert!(!fits || other.computed_pixels() >= found.computed_pixels());
            }
        }
    }

    /// The largest halo is an image's side: nothing wraps.
    #[test]
    fn a_huge_halo_is_the_whole_image() {
        for halo in [MAX_SIDE, usize::MAX - 31, usize::MAX] {
            let tiling = Tiling {
                halo,
                ..Tiling::default()
            };
            let error = plan((736, 1280), tiling, 736 * 1280 - 1).expect_err("no tile is smaller");
            assert_eq!(error.tile, 1280);
        }
    }

    #[test]
    fn the_longest_side_is_respected() {
        let tiling = Tiling {
            side: Some(300),
            ..Tiling::default()
        };
        let tiles = plan((736, 1280), tiling, u64::MAX).expect("no limit");
        let cores = tiles.rows.iter().chain(&tiles.columns);
        // 40 and 23 blocks of 32, at most 9 per tile: 5 tiles of 8, and 3 of 7 or 8.
        assert_eq!(cores.map(|span| span.core.len()).max(), Some(256));
    }

    #[test]
    fn an_image_too_large_names_the_smallest_tile() {
        let error = plan((4320, 7680), Tiling::default(), 1 << 10).expect_err("1 KiB");
        assert_eq!(error.tile, 416);
    }
}
