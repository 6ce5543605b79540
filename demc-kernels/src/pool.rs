//! Max-pooling over 2x2 windows with stride 2.
//!
//! NaN anywhere in a window is its maximum. The gradient of a window goes to exactly one value, NaN
//! or not.

use crate::simd::{self, Leaf, Simd};
use crate::tasks;
use crate::{Grid, Isa};

/// The maximum of each 2x2 window. An odd last row or column is ignored.
///
/// # Shapes
/// `x` on `grid`, `y` on `grid.halved()`, with the same number of channels.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, x: &[f32], y: &mut [f32]) {
    let channels = check(grid, x.len(), y.len());
    let half = grid.halved();
    if half.pixels() == 0 {
        return;
    }
    let (row, half_row) = (grid.width * channels, half.width * channels);
    let images = x
        .chunks(grid.height * row)
        .zip(y.chunks_mut(half.height * half_row));
    let rows = tasks::rows_per_task(2 * row);
    let pieces =
        images.flat_map(|(x, y)| x.chunks(rows * 2 * row).zip(y.chunks_mut(rows * half_row)));
    tasks::each(pieces, |(x, y)| {
        // SAFETY: the leaf has slices and checks its reads.
        unsafe {
            simd::run(
                isa,
                PoolForward {
                    channels,
                    row,
                    half_row,
                    x,
                    y,
                },
            )
        }
    });
}

/// Overwrites `dx`, the gradient with respect to `x`: `dy` at the first maximum of each window in
/// row-major order, 0 elsewhere.
///
/// # Shapes
/// `x` and `dx` on `grid`, `dy` on `grid.halved()`, with the same number of channels.
///
/// # Panics
/// If a length does not match the others.
pub fn backward(isa: Isa, grid: Grid, x: &[f32], dy: &[f32], dx: &mut [f32]) {
    let channels = check(grid, x.len(), dy.len());
    assert_eq!(x.len(), dx.len(), "input and its gradient on {grid:?}");
    let half = grid.halved();
    if half.pixels() == 0 {
        dx.fill(0.0);
        return;
    }
    let (row, half_row) = (grid.width * channels, half.width * channels);
    let image = grid.height * row;
    let images = x
        .chunks(image)
        .zip(dy.chunks(half.height * half_row))
        .zip(dx.chunks_mut(image));
    let rows = tasks::rows_per_task(2 * row);
    let pieces = images.flat_map(|((x, dy), dx)| {
        // An odd last row may form a piece without windows.
        let dy = dy.chunks(rows * half_row).chain(std::iter::repeat(&[][..]));
        x.chunks(rows * 2 * row)
            .zip(dy)
            .zip(dx.chunks_mut(rows * 2 * row))
    });
    tasks::each(pieces, |((x, dy), dx)| {
        // SAFETY: the leaf has slices and checks its reads.
        unsafe {
            simd::run(
                isa,
                PoolBackward {
                    channels,
                    row,
                    half_row,
                    x,
                    dy,
                    dx,
                },
            )
        }
    });
}

#[track_caller]
fn check(grid: Grid, len: usize, half_len: usize) -> usize {
    let channels = grid.channels(len);
    let expected = grid.halved().pixels() * channels;
    assert_eq!(
        half_len, expected,
        "values of a map of {channels} channels on {grid:?}, halved"
    );
    channels
}

/// Pairs of rows of an image, `row` values each, to rows of `half_row` values.
struct PoolForward<'a> {
    channels: usize,
    row: usize,
    half_row: usize,
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Leaf for PoolForward<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        for (x, y) in self
            .x
            .chunks_exact(2 * self.row)
            .zip(self.y.chunks_mut(self.half_row))
        {
            let (top, bottom) = x.split_at(self.row);
            let pairs = top
                .chunks_exact(2 * self.channels)
                .zip(bottom.chunks_exact(2 * self.channels));
            for ((top, bottom), y) in pairs.zip(y.chunks_exact_mut(self.channels)) {
                let ((a, b), (c, d)) =
                    (top.split_at(self.channels), bottom.split_at(self.channels));
                let [a, b, c, d] = [a, b, c, d].map(<[f32]>::as_ptr);
                let y = y.as_mut_ptr();
                // SAFETY: a, b, c, d and y have `channels` values each, and `at + n` is at most
                // that.
                unsafe {
                    let mut offset = 0;
                    while offset + S::LANES <= self.channels {
                        let [a, b, c, d] = [a, b, c, d].map(|p| S::load(p.add(offset)));
                        S::store(y.add(offset), greatest::<S>(a, b, c, d));
                        offset += S::LANES;
                    }
                    let n = self.channels - offset;
                    if n > 0 {
                        let [a, b, c, d] = [a, b, c, d].map(|p| S::load_part(p.add(offset), n));
                        S::store_part(y.add(offset), n, greatest::<S>(a, b, c, d));
                    }
                }
            }
        }
    }
}

/// # Safety
/// The machine has the path of `S`.
#[inline(always)]
unsafe fn greatest<S: Simd>(a: S::V, b: S::V, c: S::V, d: S::V) -> S::V {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let pick = |first, second| S::nan_or(second, S::greater(second, first, second, first));
        pick(pick(a, b), pick(c, d))
    }
}

/// Pairs of rows of an image and their gradient; an odd row may follow.
struct PoolBackward<'a> {
    channels: usize,
    row: usize,
    half_row: usize,
    x: &'a [f32],
    dy: &'a [f32],
    dx: &'a mut [f32],
}

impl Leaf for PoolBackward<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let (pair, channels) = (2 * self.row, self.channels);
        let whole = self.x.len() / pair * pair;
        let (dx, odd) = self.dx.split_at_mut(whole);
        odd.fill(0.0);
        let rows = self.x.chunks_exact(pair).zip(dx.chunks_exact_mut(pair));
        for ((x, dx), dy) in rows.zip(self.dy.chunks(self.half_row)) {
            let (top, bottom) = x.split_at(self.row);
            let (dtop, dbottom) = dx.split_at_mut(self.row);
            let pairs = top
                .chunks_exact(2 * channels)
                .zip(bottom.chunks_exact(2 * channels));
            let mut dtops = dtop.chunks_exact_mut(2 * channels);
            let mut dbottoms = dbottom.chunks_exact_mut(2 * channels);
            let dpairs = dtops.by_ref().zip(dbottoms.by_ref());
            for (((top, bottom), (dtop, dbottom)), dy) in
                pairs.zip(dpairs).zip(dy.chunks_exact(channels))
            {
                let ((a, b), (c, d)) = (top.split_at(channels), bottom.split_at(channels));
                let ((da, db), (dc, dd)) =
                    (dtop.split_at_mut(channels), dbottom.split_at_mut(channels));
                let from = [a, b, c, d, dy].map(<[f32]>::as_ptr);
                let target = [da, db, dc, dd].map(<[f32]>::as_mut_ptr);
                // SAFETY: all nine have `channels` values, and `at + n` is at most that.
                unsafe {
                    let mut offset = 0;
                    while offset + S::LANES <= channels {
                        let [a, b, c, d, dy] = from.map(|p| S::load(p.add(offset)));
                        for (p, v) in target.into_iter().zip(spread::<S>(a, b, c, d, dy)) {
                            S::store(p.add(offset), v);
                        }
                        offset += S::LANES;
                    }
                    let n = channels - offset;
                    if n > 0 {
                        let [a, b, c, d, dy] = from.map(|p| S::load_part(p.add(offset), n));
                        for (p, v) in target.into_iter().zip(spread::<S>(a, b, c, d, dy)) {
                            S::store_part(p.add(offset), n, v);
                        }
                    }
                }
            }
            dtops.into_remainder().fill(0.0);
            dbottoms.into_remainder().fill(0.0);
        }
    }
}

/// `dy` to the first maximum of `a`, `b` (top) and `c`, `d` (bottom).
///
/// # Safety
/// The machine has the path of `S`.
#[inline(always)]
unsafe fn spread<S: Simd>(a: S::V, b: S::V, c: S::V, d: S::V, dy: S::V) -> [S::V; 4] {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let zero = S::zero();
        let (top, bottom) = (S::greater(b, a, b, a), S::greater(d, c, d, c));
        let dtop = S::greater(bottom, top, zero, dy);
        let dbottom = S::greater(bottom, top, dy, zero);
        [
            S::greater(b, a, zero, dtop),
            S::greater(b, a, dtop, zero),
            S::greater(d, c, zero, dbottom),
            S::greater(d, c, dbottom, zero),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{bits, pattern, same_on_any_number_of_threads};

    fn cases() -> Vec<(Grid, usize)> {
        let all = [
            (1, 1, 1, 3),
            (1, 2, 2, 1),
            (2, 3, 5, 3),
            (1, 5, 2, 12),
            (1, 1, 6, 2),
            (2, 7, 4, 17),
            (2, 6, 6, 64),
            (1, 4, 3, 512),
            (2, 131, 65, 6),
            (1, 3, 700, 16),
        ];
        let few = if cfg!(miri) { 6 } else { all.len() };
        all[..few]
            .iter()
            .map(|&(batch, height, width, c)| {
                (
                    Grid {
                        batch,
                        height,
                        width,
                    },
                    c,
                )
            })
            .collect()
    }

    /// Few different values, so that windows have several maxima.
    fn map(grid: Grid, channels: usize) -> Vec<f32> {
        pattern(grid.pixels() * channels, 1)
            .iter()
            .map(|v| (v * 2.0).round())
            .collect()
    }

    fn plain(grid: Grid, channels: usize, x: &[f32]) -> Vec<(f32, usize)> {
        let half = grid.halved();
        let mut found = Vec::new();
        for b in 0..grid.batch {
            for (py, px) in (0..half.height).flat_map(|py| (0..half.width).map(move |px| (py, px)))
            {
                for c in 0..channels {
                    let offset = |t: usize| {
                        ((b * grid.height + 2 * py + t / 2) * grid.width + 2 * px + t % 2)
                            * channels
                            + c
                    };
                    let first = (1..4).fold(offset(0), |best, t| {
                        if x[offset(t)] > x[best] {
                            offset(t)
                        } else {
                            best
                        }
                    });
                    found.push((x[first], first));
                }
            }
        }
        found
    }

    #[test]
    fn forward_and_backward_are_those_of_plain_loops() {
        for (grid, channels) in cases() {
            let x = map(grid, channels);
            let expected = plain(grid, channels, &x);
            let dy = pattern(expected.len(), 2);
            let mut expected_dx = vec![0.0; x.len()];
            expected
                .iter()
                .zip(&dy)
                .for_each(|((_, offset), dy)| expected_dx[*offset] = *dy);
            for isa in Isa::available() {
                let mut y = vec![f32::NAN; expected.len()];
                forward(isa, grid, &x, &mut y);
                assert!(
                    y.iter().zip(&expected).all(|(y, (e, _))| y == e),
                    "{isa} {grid:?} of {channels}"
                );
                let mut dx = vec![f32::NAN; x.len()];
                backward(isa, grid, &x, &dy, &mut dx);
                assert!(dx == expected_dx, "{isa} {grid:?} of {channels}");
            }
        }
    }

    #[test]
    fn nan_is_the_maximum_at_any_position() {
        let grid = Grid {
            batch: 1,
            height: 2,
            width: 2,
        };
        for isa in Isa::available() {
            for offset in 0..4 {
                let mut x = [1.0, f32::INFINITY, 2.0, 3.0];
                x[offset] = f32::NAN;
                let mut y = [0.0];
                forward(isa, grid, &x, &mut y);
                assert!(y[0].is_nan(), "{isa}: {x:?}");
                let mut dx = [9.0; 4];
                backward(isa, grid, &x, &[0.5], &mut dx);
                assert_eq!(dx.iter().sum::<f32>(), 0.5, "{isa}: {x:?}");
            }
        }
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes minutes")]
    fn bits_do_not_depend_on_the_threads() {
        let grid = Grid {
            batch: 2,
            height: 61,
            width: 200,
        };
        let x = map(grid, 5);
        let len = grid.halved().pixels() * 5;
        for isa in Isa::available() {
            same_on_any_number_of_threads(|| {
                let (mut y, mut dx) = (vec![0.0; len], vec![0.0; x.len()]);
                forward(isa, grid, &x, &mut y);
                backward(isa, grid, &x, &y, &mut dx);
                (bits(&y), bits(&dx))
            });
        }
    }

    #[test]
    #[should_panic(expected = "halved")]
    fn lengths_are_checked() {
        forward(
            Isa::Portable,
            Grid {
                batch: 1,
                height: 4,
                width: 4,
            },
            &[0.0; 32],
            &mut [0.0; 9],
        );
    }
}
