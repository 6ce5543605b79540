//! Products over contiguous pixels: the basis of the 1x1 convolution and the deconvolution.
//!
//! A *run* is a range of pixels, each a row of channels. The forward pass multiplies rows of pixels
//! by a packed weight. The backward pass multiplies by the transposed weight; the gradient of the
//! weight is a reduction over pixels. A convolution with several taps or inputs is a sum of such
//! products over different rows.

mod copy;
mod outer;

use rayon::prelude::*;

use crate::Isa;
use crate::product::{Left, Panels, Right, Size, Target, padded_rows, product};
use crate::scratch::{Scratch, Shared};
use crate::simd::{Leaf, Simd, run};

use copy::finish;
pub(crate) use copy::{Copy, column_sums, copy};
pub(crate) use outer::{Outer, PaddedRows, add_outer, outer, whole};

/// Maximum number of rows of a product that are computed at once.
pub(crate) const BLOCK: usize = 96;

/// A weight `[depth, columns]`, packed for the products of one path.
pub(crate) struct Packed {
    depth: usize,
    columns: usize,
    values: Scratch,
}

struct PackRows<'a, F> {
    rows: std::ops::Range<usize>,
    depth: usize,
    columns: usize,
    value: &'a F,
    target: Shared,
}

impl<F: Fn(usize, usize) -> f32> Leaf for PackRows<'_, F> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let panels = Panels::new::<S>(self.columns);
        for k in self.rows {
            for first in (0..panels.padded).step_by(S::LANES) {
                let place = panels.place(self.depth, k, first);
                for lane in 0..S::LANES {
                    let column = first + lane;
                    let value = if column < self.columns {
                        (self.value)(k, column)
                    } else {
                        0.0
                    };
                    // SAFETY: row `k` is this leaf's, and its vectors lie within the operand.
                    unsafe { *self.target.pointer().add(place + lane) = value };
                }
            }
        }
    }
}

impl Packed {
    /// Packs a weight with the entry `value(k, column)` in row `k`.
    pub(crate) fn new(
        isa: Isa,
        depth: usize,
        columns: usize,
        value: impl Fn(usize, usize) -> f32 + Sync,
    ) -> Self {
        let mut values = Scratch::take(depth * whole(columns));
        let target = Shared::new(&mut values);
        let step = (8192 / columns).max(1);
        (0..depth.div_ceil(step)).into_par_iter().for_each(|task| {
            let rows = task * step..((task + 1) * step).min(depth);
            // SAFETY: tasks write different rows.
            unsafe {
                run(
                    isa,
                    PackRows {
                        rows,
                        depth,
                        columns,
                        value: &value,
                        target,
                    },
                )
            };
        });
        Packed {
            depth,
            columns,
            values,
        }
    }

    /// A weight `[depth, columns]`; the caller writes the packed values.
    pub(crate) fn empty(depth: usize, columns: usize) -> Self {
        Packed {
            depth,
            columns,
            values: Scratch::take(depth * whole(columns)),
        }
    }

    pub(crate) fn columns(&self) -> usize {
        self.columns
    }

    /// The packed values; see [`Panels::place`].
    pub(crate) fn values(&mut self) -> Shared {
        Shared::new(&mut self.values)
    }
}

/// Rows per block, at most [`BLOCK`], chosen so that there are enough blocks for all threads.
pub(crate) fn block_rows(rows: usize) -> usize {
    let blocks = rows
        .div_ceil(BLOCK)
        .next_multiple_of(rayon::current_num_threads());
    rows.div_ceil(blocks)
}

/// One term of a sum of products: rows `step` values apart, times a weight.
#[derive(Clone, Copy)]
pub(crate) struct Term<'a> {
    pub(crate) rows: &'a [f32],
    pub(crate) step: usize,
    pub(crate) weight: &'a Packed,
}

struct Sum<'a> {
    count: usize,
    terms: &'a [Term<'a>],
    add: bool,
    c: &'a mut [f32],
    c_step: usize,
}

impl Leaf for Sum<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let rows = padded_rows(self.count);
        assert!(self.c.len() >= rows * self.c_step, "room for {rows} rows");
        for (index, term) in self.terms.iter().enumerate() {
            let Packed {
                depth,
                columns,
                values,
            } = term.weight;
            assert!(*columns <= self.c_step && term.rows.len() >= (rows - 1) * term.step + depth);
            // SAFETY: just checked; the weight was packed for this depth and these columns.
            unsafe {
                let a = Left {
                    start: term.rows.as_ptr(),
                    row_step: term.step,
                    k_step: 1,
                };
                let b = Right::Packed(values.as_ptr());
                let size = Size {
                    rows: self.count,
                    depth: *depth,
                    columns: *columns,
                };
                let c = Target {
                    start: self.c.as_mut_ptr(),
                    step: self.c_step,
                    accumulate: self.add || index > 0,
                };
                product::<S>(size, a, b, c);
            }
        }
    }
}

/// Writes the sum of the terms, `count` rows, to `c`; the rows of `c` are `c_step` values apart.
///
/// # Panics
/// If a slice is shorter than [`padded_rows`] of `count` requires.
pub(crate) fn sum(isa: Isa, count: usize, terms: &[Term], c: &mut [f32], c_step: usize) {
    // SAFETY: the leaf checks its lengths.
    unsafe {
        run(
            isa,
            Sum {
                count,
                terms,
                add: false,
                c,
                c_step,
            },
        )
    }
}

/// As [`sum`], added to the content of `c`.
pub(crate) fn add_sum(isa: Isa, count: usize, terms: &[Term], c: &mut [f32], c_step: usize) {
    // SAFETY: the leaf checks its lengths.
    unsafe {
        run(
            isa,
            Sum {
                count,
                terms,
                add: true,
                c,
                c_step,
            },
        )
    }
}

/// Writes the sum of the terms to `y`, rows without gaps, or adds it if `add`. Then adds the bias and
/// rectifies if `relu`.
///
/// # Panics
/// If a slice of a term is shorter than [`padded_rows`] of the rows of `y` requires.
pub(crate) fn write_sum(
    isa: Isa,
    terms: &[Term],
    add: bool,
    bias: Option<&[f32]>,
    relu: bool,
    y: &mut [f32],
) {
    let columns = terms[0].weight.columns();
    let (count, wide) = (y.len() / columns, whole(columns));
    let write = if add { add_sum } else { sum };
    // Without padded rows and columns, the product needs no room of its own.
    let fits = padded_rows(count) == count && wide == columns;
    if fits && (bias.is_some() || !relu) {
        write(isa, count, terms, y, columns);
        if let Some(bias) = bias {
            finish(isa, bias, relu, y);
        }
        return;
    }
    let mut c = Scratch::take(padded_rows(count) * wide);
    if add {
        copy(
            isa,
            Copy {
                from: y,
                from_step: columns,
                gate: None,
                bias: None,
                relu: false,
                target: &mut c,
                target_step: wide,
                rows: count,
                channels: columns,
            },
        );
    }
    write(isa, count, terms, &mut c, wide);
    copy(
        isa,
        Copy {
            from: &c,
            from_step: wide,
            gate: None,
            bias,
            relu,
            target: y,
            target_step: columns,
            rows: count,
            channels: columns,
        },
    );
}
