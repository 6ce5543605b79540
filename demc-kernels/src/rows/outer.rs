//! Gradients of weights: products with a reduction over pixels.

use rayon::prelude::*;

use crate::Isa;
use crate::product::{Left, ROW_BLOCK, Right, Size, Target, padded_rows, product};
use crate::scratch::{Scratch, Shared};
use crate::simd::{Leaf, Simd, run};

/// Columns rounded up to whole vectors of every path.
pub(crate) fn whole(columns: usize) -> usize {
    columns.next_multiple_of(16)
}

/// One gradient of a weight: the sum over pixels of a row of `a` times a row of `b`.
#[derive(Clone, Copy)]
pub(crate) struct Outer<'a> {
    pub(crate) a: &'a [f32],
    pub(crate) a_step: usize,
    /// Columns of `a`, which are the rows of the gradient.
    pub(crate) rows: usize,
    pub(crate) b: &'a [f32],
    pub(crate) b_step: usize,
    /// Columns of `b` and of the gradient.
    pub(crate) columns: usize,
    pub(crate) pixels: usize,
}

/// Pixels that a reduction covers before it moves to another block of the gradient: both operands
/// stay in a cache.
const STRETCH: usize = 256;

struct Reduce<'a> {
    outer: Outer<'a>,
    first: usize,
    count: usize,
    /// Whether to add to the content of `c`.
    add: bool,
    c: Shared,
    c_step: usize,
}

impl Leaf for Reduce<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Outer {
            a,
            a_step,
            b,
            b_step,
            columns,
            pixels,
            ..
        } = self.outer;
        let rows = self.first + padded_rows(self.count);
        assert!(
            pixels > 0 && a.len() >= (pixels - 1) * a_step + rows,
            "rows of the left operand"
        );
        assert!(
            b.len() >= (pixels - 1) * b_step + columns.next_multiple_of(S::LANES),
            "rows of the right operand"
        );
        for pixel in (0..pixels).step_by(STRETCH) {
            let depth = STRETCH.min(pixels - pixel);
            // SAFETY: just checked; rows of `c` from `first` are this leaf's, padded.
            unsafe {
                let left = Left {
                    start: a.as_ptr().add(pixel * a_step + self.first),
                    row_step: 1,
                    k_step: a_step,
                };
                let right = Right::Rows {
                    start: b.as_ptr().add(pixel * b_step),
                    step: b_step,
                };
                let size = Size {
                    rows: self.count,
                    depth,
                    columns,
                };
                let target = Target {
                    start: self.c.pointer().add(self.first * self.c_step),
                    step: self.c_step,
                    accumulate: self.add || pixel > 0,
                };
                product::<S>(size, left, right, target);
            }
        }
    }
}

/// Rows of a gradient per task.
const TASK_ROWS: usize = 48;

/// The gradients, one matrix `[padded_rows(rows), c_step]` after another.
///
/// `a` needs 24 values beyond its last row.
pub(crate) fn outer(isa: Isa, outers: &[Outer], c_step: usize) -> Scratch {
    let sizes: Vec<usize> = outers
        .iter()
        .map(|outer| padded_rows(outer.rows) * c_step)
        .collect();
    let mut c = Scratch::take(sizes.iter().sum());
    let shared = Shared::new(&mut c);
    let mut tasks = Vec::new();
    let mut start = 0;
    for (outer, size) in outers.iter().zip(sizes) {
        let c = shared.offset(start);
        for first in (0..outer.rows).step_by(TASK_ROWS) {
            let count = TASK_ROWS.min(outer.rows - first);
            tasks.push((*outer, first, count, c));
        }
        start += size;
    }
    tasks.into_par_iter().for_each(|(outer, first, count, c)| {
        // SAFETY: tasks write different rows: 48 is a multiple of the height of every block of
        // rows, and the last block is padded.
        unsafe {
            run(
                isa,
                Reduce {
                    outer,
                    first,
                    count,
                    add: false,
                    c,
                    c_step,
                },
            )
        }
    });
    c
}

/// Adds a gradient to `c`, `[padded_rows(rows), c_step]`, on the calling thread.
///
/// # Panics
/// If a slice is shorter.
pub(crate) fn add_outer(isa: Isa, outer: Outer, c: &mut [f32], c_step: usize) {
    assert!(
        c.len() >= padded_rows(outer.rows) * c_step && c_step >= whole(outer.columns),
        "room for the gradient"
    );
    let leaf = Reduce {
        outer,
        first: 0,
        count: outer.rows,
        add: true,
        c: Shared::new(c),
        c_step,
    };
    // SAFETY: `c` holds all rows, padded, of whole vectors, and is this call's alone.
    unsafe { run(isa, leaf) }
}

/// The rows of a slice from `first` on, copied if the slice has no room for whole blocks of them.
pub(crate) struct PaddedRows<'a> {
    slice: &'a [f32],
    copy: Option<Scratch>,
}

impl<'a> PaddedRows<'a> {
    /// `count` rows of `step` values from `first`.
    pub(crate) fn new(map: &'a [f32], step: usize, first: usize, count: usize) -> Self {
        let slice = &map[first * step..];
        // Padded rows for a product over them, and extra values for a reduction along them.
        let needed = padded_rows(count) * step + ROW_BLOCK;
        if slice.len() >= needed {
            return PaddedRows { slice, copy: None };
        }
        let mut copy = Scratch::zeroed(needed);
        copy[..count * step].copy_from_slice(&slice[..count * step]);
        PaddedRows {
            slice,
            copy: Some(copy),
        }
    }

    pub(crate) fn rows(&self) -> &[f32] {
        match &self.copy {
            Some(copy) => copy,
            None => self.slice,
        }
    }
}
