//! How an image is cut into tiles that a device has the memory for, so that the tiles together are the whole image.
//!
//! An output pixel depends on inputs at most 188 px away in the encoders and the decoder, and 4 px more in the fusion
//! sub-network: with a halo of 192 px ([`EXACT_HALO`]) around each tile, cut off again from its output, and with origins on
//! multiples of 32, where the network's own grid is, nothing changes but the order of some sums. At an image's edge the halo ends,
//! as the image does. A smaller halo is faster and only nearly the same.
//!
//! Tiles form a grid. Of all grids whose largest tile fits, the plan is the one that computes the fewest pixels.

use std::ops::Range;

use demc_model::DOWNSAMPLING;

use crate::memory::TooLarge;

/// Width of the halo in pixels with which tiles equal the whole image: the receptive field's reach (`188 + 4`).
pub const EXACT_HALO: usize = 192;

/// How an image may be cut; the default is exact, in as few and as large tiles as memory allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tiling {
    /// Width of the halo in pixels, taken up to a multiple of 32; below [`EXACT_HALO`] the result is approximate.
    pub halo: usize,
    /// Longest side of a tile in pixels without its halo, at least 32, taken down to a multiple of 32; none: as memory allows.
    pub side: Option<usize>,
    /// Bytes that a pass may take; none: what is there.
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
    /// Whether the tiles together equal the whole image.
    pub fn is_exact(&self) -> bool {
        self.halo >= EXACT_HALO
    }

    /// The halo on the network's grid.
    fn grid_halo(&self) -> usize {
        self.halo.next_multiple_of(DOWNSAMPLING)
    }
}

/// The tiles of a padded image: every combination of a row and a column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tiles {
    /// From the top down.
    pub rows: Vec<Span>,
    /// From left to right.
    pub columns: Vec<Span>,
}

/// One tile's share of an axis, in pixels; both ranges start and end on multiples of 32.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Span {
    /// What it makes. The spans of an axis lie side by side.
    pub core: Range<usize>,
    /// What it reads: the core with its halo, as far as the image goes.
    pub read: Range<usize>,
}

impl Tiles {
    /// The best grid for a padded image of `height` x `width` pixels, multiples of 32, in which no tile takes more than `available`
    /// bytes (none: no limit); `need` tells how many one of a height and a width takes.
    ///
    /// # Errors
    /// If not even the smallest tile fits.
    pub fn plan(
        (height, width): (usize, usize),
        tiling: &Tiling,
        need: impl Fn(usize, usize) -> u64,
        available: Option<u64>,
    ) -> Result<Self, TooLarge> {
        let halo = tiling.grid_halo();
        let fits = |rows: &[Span], columns: &[Span]| {
            available.is_none_or(|bytes| need(longest(rows), longest(columns)) <= bytes)
        };
        let axis = |length: usize| -> Vec<Vec<Span>> {
            let side = tiling.side.unwrap_or(length).max(DOWNSAMPLING);
            let blocks = length / DOWNSAMPLING;
            let fewest = blocks.div_ceil(side / DOWNSAMPLING);
            (fewest..=blocks)
                .map(|count| spans(blocks, count, halo))
                .collect()
        };
        let (rows, columns) = (axis(height), axis(width));
        let mut best: Option<(u64, Self)> = None;
        for rows in &rows {
            // Finer columns than the first that fit compute more.
            let Some(columns) = columns.iter().find(|columns| fits(rows, columns)) else {
                continue;
            };
            let tiles = Self {
                rows: rows.clone(),
                columns: columns.clone(),
            };
            let computed = tiles.computed_pixels();
            if best.as_ref().is_none_or(|(least, _)| computed < *least) {
                best = Some((computed, tiles));
            }
        }
        best.map(|(_, tiles)| tiles).ok_or_else(|| {
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

    /// All tiles: rows, columns.
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

/// An axis of `blocks` times 32 pixels in `count` spans, as equal as they get.
fn spans(blocks: usize, count: usize, halo: usize) -> Vec<Span> {
    let edge = |i: usize| i * blocks / count * DOWNSAMPLING;
    (0..count)
        .map(|i| Span {
            core: edge(i)..edge(i + 1),
            read: edge(i).saturating_sub(halo)..(edge(i + 1) + halo).min(blocks * DOWNSAMPLING),
        })
        .collect()
}

fn longest(spans: &[Span]) -> usize {
    let lengths = spans.iter().map(|span| span.read.len());
    lengths.max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A byte a pixel.
    fn pixels(height: usize, width: usize) -> u64 {
        (height * width) as u64
    }

    fn plan(size: (usize, usize), tiling: Tiling, available: u64) -> Result<Tiles, TooLarge> {
        Tiles::plan(size, &tiling, pixels, Some(available))
    }

    #[test]
    fn what_fits_stays_whole() {
        let tiles = plan((736, 1280), Tiling::default(), 736 * 1280).expect("it fits");
        assert_eq!((tiles.count(), tiles.largest()), (1, (736, 1280)));
        assert_eq!(tiles.computed_pixels(), 736 * 1280);
    }

    /// Cores cover every pixel once; a halo is whole but at the image's edge; every number is on the grid of 32; nothing is above
    /// the limit.
    #[test]
    fn tiles_cover_the_image_once_whatever_the_limit() {
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

    /// The least of all grids, found by trying every one.
    #[test]
    fn no_grid_that_fits_computes_less() {
        let (height, width, available) = (736, 1280, 900 * 700);
        let found = plan((height, width), Tiling::default(), available).expect("it fits");
        for rows in 1..=height / 32 {
            for columns in 1..=width / 32 {
                let other = Tiles {
                    rows: spans(height / 32, rows, EXACT_HALO),
                    columns: spans(width / 32, columns, EXACT_HALO),
                };
                let (tall, wide) = other.largest();
                let fits = (tall * wide) as u64 <= available;
                assert!(!fits || other.computed_pixels() >= found.computed_pixels());
            }
        }
    }

    #[test]
    fn a_side_that_is_asked_for_is_kept() {
        let tiling = Tiling {
            side: Some(300),
            ..Tiling::default()
        };
        let tiles = plan((736, 1280), tiling, u64::MAX).expect("no limit");
        let cores = tiles.rows.iter().chain(&tiles.columns);
        // 40 and 23 blocks of 32, 9 of them at most in one: 5 tiles of 8, and 3 of 7 or 8.
        assert_eq!(cores.map(|span| span.core.len()).max(), Some(256));
    }

    #[test]
    fn where_nothing_fits_the_smallest_tile_is_named() {
        let error = plan((4320, 7680), Tiling::default(), 1 << 10).expect_err("1 KiB");
        assert_eq!(error.tile, 416);
    }
}
