//! The matrix product behind all convolutions, `C = A B`. It reads A by values and B and C by
//! vectors.
//!
//! With channels last, a row of A is a pixel, and a row of B holds the weights from one input
//! channel to all output channels. The inner loop multiplies one value of A with a vector of B into
//! an accumulator. A block of accumulators, rows times columns, stays in registers over the whole
//! reduction.
//!
//! These are the innermost two loops of Goto and van de Geijn (2008). The callers run the outer
//! loops, over blocks that fit a cache.

use crate::simd::Simd;

/// Blocks of this many rows are computed whole: A must be readable and C writable for them.
pub(crate) const ROW_BLOCK: usize = 24;

/// `rows` rounded up to whole blocks.
pub(crate) fn padded_rows(rows: usize) -> usize {
    rows.next_multiple_of(ROW_BLOCK)
}

/// A left operand: `A(row, k) = *(start + row * row_step + k * k_step)`.
#[derive(Clone, Copy)]
pub(crate) struct Left {
    pub(crate) start: *const f32,
    pub(crate) row_step: usize,
    pub(crate) k_step: usize,
}

/// A right operand, in panels of [`Simd::COLUMNS`] vectors of columns; the last panel may be
/// narrower.
#[derive(Clone, Copy)]
pub(crate) enum Right {
    /// Panels one after another, each `[k][columns of the panel]`: see [`Panels`].
    Packed(*const f32),
    /// Rows in their original layout, `step` values apart, readable up to whole vectors.
    Rows { start: *const f32, step: usize },
}

/// Extents of a product.
#[derive(Clone, Copy)]
pub(crate) struct Size {
    pub(crate) rows: usize,
    /// Length of the reduction.
    pub(crate) depth: usize,
    pub(crate) columns: usize,
}

/// The result: rows `step` values apart.
#[derive(Clone, Copy)]
pub(crate) struct Target {
    pub(crate) start: *mut f32,
    pub(crate) step: usize,
    /// Whether the product is added to the content.
    pub(crate) accumulate: bool,
}

/// Some columns of a right operand: rows `step` values apart.
#[derive(Clone, Copy)]
struct Panel {
    start: *const f32,
    step: usize,
}

/// The division of `columns` of a packed right operand into panels.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Panels {
    /// Columns, rounded up to whole vectors.
    pub(crate) padded: usize,
    pub(crate) full: usize,
}

impl Panels {
    pub(crate) fn new<S: Simd>(columns: usize) -> Self {
        Panels {
            padded: columns.next_multiple_of(S::LANES),
            full: S::COLUMNS * S::LANES,
        }
    }

    /// Index of the vector at `column` of row `k`, for `depth` rows.
    pub(crate) fn place(self, depth: usize, k: usize, column: usize) -> usize {
        let first = column / self.full * self.full;
        let width = self.full.min(self.padded - first);
        first * depth + k * width + (column - first)
    }
}

/// `C = A B`, or `C += A B`.
///
/// # Safety
/// The machine has the path of `S`. A is readable and C writable for [`padded_rows`]; B and C have
/// whole vectors of columns.
#[inline(always)]
pub(crate) unsafe fn product<S: Simd>(size: Size, a: Left, b: Right, c: Target) {
    let Size {
        rows,
        depth,
        columns,
    } = size;
    let panels = Panels::new::<S>(columns);
    let mut first = 0;
    while first < panels.padded {
        let width = panels.full.min(panels.padded - first);
        let b = match b {
            Right::Packed(start) => Panel {
                // SAFETY: the panel lies within the operand.
                start: unsafe { start.add(first * depth) },
                step: width,
            },
            Right::Rows { start, step } => Panel {
                // SAFETY: as above.
                start: unsafe { start.add(first) },
                step,
            },
        };
        // SAFETY: the columns from `first` are C's; the rest is the caller's.
        unsafe {
            let start = c.start.add(first);
            let c = Target { start, ..c };
            match (width / S::LANES, S::ACCUMULATORS) {
                (4, _) => strip::<S, 6, 4>(rows, depth, a, b, c),
                (3, _) => strip::<S, 8, 3>(rows, depth, a, b, c),
                (2, 24..) => strip::<S, 12, 2>(rows, depth, a, b, c),
                (2, 12..) => strip::<S, 6, 2>(rows, depth, a, b, c),
                (2, _) => strip::<S, 4, 2>(rows, depth, a, b, c),
                (_, 12..) => strip::<S, 12, 1>(rows, depth, a, b, c),
                _ => strip::<S, 8, 1>(rows, depth, a, b, c),
            }
        }
        first += width;
    }
}

/// One panel of columns: blocks of `R` rows.
#[inline(always)]
unsafe fn strip<S: Simd, const R: usize, const V: usize>(
    rows: usize,
    depth: usize,
    a: Left,
    b: Panel,
    c: Target,
) {
    let mut row = 0;
    while row < rows {
        // SAFETY: rows up to `padded_rows` are there.
        unsafe {
            let a_start = a.start.add(row * a.row_step);
            let c_start = c.start.add(row * c.step);
            block::<S, R, V>(
                depth,
                Left {
                    start: a_start,
                    ..a
                },
                b,
                Target {
                    start: c_start,
                    ..c
                },
            );
        }
        row += R;
    }
}

/// `R` rows of `V` vectors, in registers.
#[inline(always)]
#[allow(
    clippy::needless_range_loop,
    reason = "indices of registers: loops that unroll"
)]
unsafe fn block<S: Simd, const R: usize, const V: usize>(
    depth: usize,
    a: Left,
    b: Panel,
    c: Target,
) {
    // SAFETY: the caller's: every place is a value of A, B or C.
    unsafe {
        let mut sums = [[S::zero(); V]; R];
        if c.accumulate {
            for r in 0..R {
                for v in 0..V {
                    sums[r][v] = S::load(c.start.add(r * c.step + v * S::LANES));
                }
            }
        }
        let (mut a_k, mut b_k) = (a.start, b.start);
        for _ in 0..depth {
            let mut columns = [S::zero(); V];
            for v in 0..V {
                columns[v] = S::load(b_k.add(v * S::LANES));
            }
            for r in 0..R {
                let value = S::splat(*a_k.add(r * a.row_step));
                for v in 0..V {
                    sums[r][v] = S::fma(value, columns[v], sums[r][v]);
                }
            }
            a_k = a_k.wrapping_add(a.k_step);
            b_k = b_k.wrapping_add(b.step);
        }
        for r in 0..R {
            for v in 0..V {
                S::store(c.start.add(r * c.step + v * S::LANES), sums[r][v]);
            }
        }
    }
}
