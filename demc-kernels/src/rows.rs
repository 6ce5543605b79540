//! Products over pixels as they lie in memory: what the 1x1 convolution and the deconvolution are made of.
//!
//! A *run* is a stretch of pixels, each a row of channels. Forward, rows of pixels times a packed weight; backward, the
//! transposed weight the same way, and for the weight's gradient a reduction over pixels. A convolution with several
//! taps or several inputs is a sum of such products, each from another place.

use rayon::prelude::*;

use crate::Isa;
use crate::product::{Left, Panels, ROW_BLOCK, Right, padded_rows, product};
use crate::scratch::{Scratch, Shared};
use crate::simd::{Leaf, Simd, run};

/// Most rows of a product that are made at once.
pub(crate) const BLOCK: usize = 96;

/// Columns rounded up to what every path's vectors fill.
pub(crate) fn whole(columns: usize) -> usize {
    columns.next_multiple_of(16)
}

/// A weight `[depth, columns]`, packed for the products of one path.
pub(crate) struct Packed {
    depth: usize,
    columns: usize,
    values: Scratch,
}

struct Pack<'a, F> {
    rows: std::ops::Range<usize>,
    depth: usize,
    columns: usize,
    value: &'a F,
    to: Shared,
}

impl<F: Fn(usize, usize) -> f32> Leaf for Pack<'_, F> {
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
                    unsafe { *self.to.pointer().add(place + lane) = value };
                }
            }
        }
    }
}

impl Packed {
    /// The weight whose entry in row `k` and a column is `value(k, column)`.
    pub(crate) fn new(
        isa: Isa,
        depth: usize,
        columns: usize,
        value: impl Fn(usize, usize) -> f32 + Sync,
    ) -> Self {
        let mut values = Scratch::take(depth * whole(columns));
        let to = Shared::new(&mut values);
        let step = (8192 / columns).max(1);
        (0..depth.div_ceil(step)).into_par_iter().for_each(|task| {
            let rows = task * step..((task + 1) * step).min(depth);
            // SAFETY: tasks write different rows.
            unsafe {
                run(
                    isa,
                    Pack {
                        rows,
                        depth,
                        columns,
                        value: &value,
                        to,
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

    /// A weight `[depth, columns]` whose packed values the caller writes.
    pub(crate) fn empty(depth: usize, columns: usize) -> Self {
        Packed {
            depth,
            columns,
            values: Scratch::take(depth * whole(columns)),
        }
    }

    /// Its columns.
    pub(crate) fn columns(&self) -> usize {
        self.columns
    }

    /// The packed values; see [`Panels::place`].
    pub(crate) fn values(&mut self) -> Shared {
        Shared::new(&mut self.values)
    }
}

/// Rows of a block, at most [`BLOCK`], of which there are enough for all threads.
pub(crate) fn block_rows(rows: usize) -> usize {
    let blocks = rows
        .div_ceil(BLOCK)
        .next_multiple_of(rayon::current_num_threads());
    rows.div_ceil(blocks)
}

/// One term of a sum of products: rows from `start`, `step` values apart, times a weight.
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
                let c = self.c.as_mut_ptr();
                product::<S>(
                    self.count,
                    *depth,
                    *columns,
                    a,
                    b,
                    c,
                    self.c_step,
                    self.add || index > 0,
                );
            }
        }
    }
}

/// The sum of the terms, `count` rows into `c`, whose rows are `c_step` values apart.
///
/// # Panics
/// Where a slice is shorter than [`padded_rows`] of `count` need.
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

/// The same, added to what `c` holds.
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

/// Copies rows of channels through vectors: gate, bias, ReLU on the way.
pub(crate) struct Copy<'a> {
    /// Rows and the distance between them.
    pub(crate) from: &'a [f32],
    pub(crate) from_step: usize,
    /// Gate of `from`, laid out as it.
    pub(crate) gate: Option<&'a [f32]>,
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) relu: bool,
    pub(crate) to: &'a mut [f32],
    pub(crate) to_step: usize,
    pub(crate) rows: usize,
    pub(crate) channels: usize,
}

impl Leaf for Copy<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        if self.rows == 0 {
            return;
        }
        let Copy {
            from_step,
            to_step,
            channels,
            ..
        } = self;
        assert!(
            self.from.len() >= (self.rows - 1) * from_step + channels,
            "rows to copy from"
        );
        assert!(
            self.to.len() >= (self.rows - 1) * to_step + channels,
            "rows to copy to"
        );
        assert!(
            self.gate
                .is_none_or(|gate| gate.len() >= (self.rows - 1) * from_step + channels)
        );
        assert!(self.bias.is_none_or(|bias| bias.len() >= channels));
        for row in 0..self.rows {
            for channel in (0..channels).step_by(S::LANES) {
                let n = S::LANES.min(channels - channel);
                // SAFETY: `n` channels of every row are there, as just checked.
                unsafe {
                    let from = row * from_step + channel;
                    let mut v = part::<S>(self.from.as_ptr().add(from), n);
                    if let Some(gate) = self.gate {
                        v = S::gate(v, part::<S>(gate.as_ptr().add(from), n));
                    }
                    if let Some(bias) = self.bias {
                        v = S::add(v, part::<S>(bias.as_ptr().add(channel), n));
                    }
                    if self.relu {
                        v = S::relu(v);
                    }
                    let to = self.to.as_mut_ptr().add(row * to_step + channel);
                    if n == S::LANES {
                        S::store(to, v)
                    } else {
                        S::store_part(to, n, v)
                    }
                }
            }
        }
    }
}

/// `n` values from `p`.
///
/// # Safety
/// They are there, and so is the path of `S`.
#[inline(always)]
unsafe fn part<S: Simd>(p: *const f32, n: usize) -> S::V {
    // SAFETY: the caller's.
    unsafe {
        if n == S::LANES {
            S::load(p)
        } else {
            S::load_part(p, n)
        }
    }
}

/// Runs a [`Copy`].
pub(crate) fn copy(isa: Isa, copy: Copy) {
    // SAFETY: the leaf checks its lengths.
    unsafe { run(isa, copy) }
}

/// Sum over rows of each channel: some `rows` (their number small enough for float32), `step` values apart.
struct ColumnSums<'a> {
    rows: &'a [f32],
    step: usize,
    count: usize,
    channels: usize,
    sums: &'a mut [f64],
}

impl Leaf for ColumnSums<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        const WIDEST: usize = 16;
        let ColumnSums {
            rows,
            step,
            count,
            channels,
            sums,
        } = self;
        assert!(count > 0 && rows.len() >= (count - 1) * step + channels && sums.len() >= channels);
        for channel in (0..channels).step_by(S::LANES) {
            let n = S::LANES.min(channels - channel);
            let mut lanes = [0.0; WIDEST];
            // SAFETY: `n` channels of every row are there, and `lanes` holds a vector.
            unsafe {
                let mut sum = S::zero();
                for row in 0..count {
                    sum = S::add(sum, part::<S>(rows.as_ptr().add(row * step + channel), n));
                }
                S::store(lanes.as_mut_ptr(), sum);
            }
            for (sum, lane) in sums[channel..channel + n].iter_mut().zip(lanes) {
                *sum += f64::from(lane);
            }
        }
    }
}

/// Adds the sum over `count` rows, `step` values apart, of each channel.
pub(crate) fn column_sums(
    isa: Isa,
    rows: &[f32],
    step: usize,
    count: usize,
    channels: usize,
    sums: &mut [f64],
) {
    // SAFETY: the leaf checks its lengths.
    unsafe {
        run(
            isa,
            ColumnSums {
                rows,
                step,
                count,
                channels,
                sums,
            },
        )
    }
}

/// One gradient of a weight: the sum over pixels of a row of `a` times a row of `b`.
#[derive(Clone, Copy)]
pub(crate) struct Outer<'a> {
    pub(crate) a: &'a [f32],
    pub(crate) a_step: usize,
    /// Columns of `a`: rows of the gradient.
    pub(crate) rows: usize,
    pub(crate) b: &'a [f32],
    pub(crate) b_step: usize,
    /// Columns of `b` and of the gradient.
    pub(crate) columns: usize,
    pub(crate) pixels: usize,
}

/// Pixels over which a reduction runs before its block of the gradient is left: both operands stay in a cache.
const STRETCH: usize = 256;

struct Reduce<'a> {
    outer: Outer<'a>,
    first: usize,
    count: usize,
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
                let c = self.c.pointer().add(self.first * self.c_step);
                product::<S>(
                    self.count,
                    depth,
                    columns,
                    left,
                    right,
                    c,
                    self.c_step,
                    pixel > 0,
                );
            }
        }
    }
}

/// Rows of a gradient that a task makes.
const TASK_ROWS: usize = 48;

/// The gradients: one matrix each, `[padded_rows(rows), c_step]`, one after the other.
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
        // SAFETY: tasks write different rows: 48 is a multiple of every block of rows, and the last is padded.
        unsafe {
            run(
                isa,
                Reduce {
                    outer,
                    first,
                    count,
                    c,
                    c_step,
                },
            )
        }
    });
    c
}

/// Rows that a slice has beyond `first`, or a copy with room for whole blocks of them.
pub(crate) struct Window<'a> {
    slice: &'a [f32],
    copy: Option<Scratch>,
}

impl<'a> Window<'a> {
    /// `count` rows of `step` values from `first`.
    pub(crate) fn new(map: &'a [f32], step: usize, first: usize, count: usize) -> Self {
        let slice = &map[first * step..];
        // Rows for a product over them, values for a reduction along them.
        let needed = padded_rows(count) * step + ROW_BLOCK;
        if slice.len() >= needed {
            return Window { slice, copy: None };
        }
        let mut copy = Scratch::zeroed(needed);
        copy[..count * step].copy_from_slice(&slice[..count * step]);
        Window {
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
