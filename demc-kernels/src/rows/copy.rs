//! Vectorised copies and sums of rows of channels.

use crate::Isa;
use crate::simd::{Leaf, Simd, WIDEST, run};

/// Copies rows of channels, with optional gate, bias and ReLU.
pub(crate) struct Copy<'a> {
    /// The rows; `from_step` is the distance between them.
    pub(crate) from: &'a [f32],
    pub(crate) from_step: usize,
    /// Gate of `from`, in the same layout.
    pub(crate) gate: Option<&'a [f32]>,
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) relu: bool,
    pub(crate) target: &'a mut [f32],
    pub(crate) target_step: usize,
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
            target_step,
            mut rows,
            mut channels,
            ..
        } = self;
        if (from_step, target_step) == (channels, channels) && self.bias.is_none() {
            // Rows without gaps are one long row.
            (rows, channels) = (1, rows * channels);
        }
        assert!(
            self.from.len() >= (rows - 1) * from_step + channels,
            "rows to copy from"
        );
        assert!(
            self.target.len() >= (rows - 1) * target_step + channels,
            "rows to copy to"
        );
        assert!(
            self.gate
                .is_none_or(|gate| gate.len() >= (rows - 1) * from_step + channels)
        );
        assert!(self.bias.is_none_or(|bias| bias.len() >= channels));
        for row in 0..rows {
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
                    let target = self.target.as_mut_ptr().add(row * target_step + channel);
                    if n == S::LANES {
                        S::store(target, v)
                    } else {
                        S::store_part(target, n, v)
                    }
                }
            }
        }
    }
}

/// Adds a bias to rows without gaps and rectifies them, in place.
struct Finish<'a> {
    bias: &'a [f32],
    relu: bool,
    rows: &'a mut [f32],
}

impl Leaf for Finish<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let channels = self.bias.len();
        for row in self.rows.chunks_exact_mut(channels) {
            for channel in (0..channels).step_by(S::LANES) {
                let n = S::LANES.min(channels - channel);
                // SAFETY: the row and the bias have `n` channels there.
                unsafe {
                    let place = row.as_mut_ptr().add(channel);
                    let bias = part::<S>(self.bias.as_ptr().add(channel), n);
                    let sum = S::add(part::<S>(place, n), bias);
                    let value = if self.relu { S::relu(sum) } else { sum };
                    if n == S::LANES {
                        S::store(place, value)
                    } else {
                        S::store_part(place, n, value)
                    }
                }
            }
        }
    }
}

/// Adds the bias to rows of as many channels, and rectifies them if `relu`, in place.
pub(crate) fn finish(isa: Isa, bias: &[f32], relu: bool, rows: &mut [f32]) {
    // SAFETY: the leaf stays within the rows.
    unsafe { run(isa, Finish { bias, relu, rows }) }
}

/// `n` values from `p`.
///
/// # Safety
/// The values are readable, and the machine has the path of `S`.
#[inline(always)]
unsafe fn part<S: Simd>(p: *const f32, n: usize) -> S::V {
    // SAFETY: guaranteed by the caller.
    unsafe {
        if n == S::LANES {
            S::load(p)
        } else {
            S::load_part(p, n)
        }
    }
}

pub(crate) fn copy(isa: Isa, copy: Copy) {
    // SAFETY: the leaf checks its lengths.
    unsafe { run(isa, copy) }
}

/// Sum over rows of each channel. Rows are `step` values apart, and few enough for sums in float32.
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

/// Adds to `sums` the sum of each channel over `count` rows, `step` values apart.
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
