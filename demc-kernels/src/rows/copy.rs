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
            channels,
            ..
        } = self;
        assert!(
            self.from.len() >= (self.rows - 1) * from_step + channels,
            "rows to copy from"
        );
        assert!(
            self.target.len() >= (self.rows - 1) * target_step + channels,
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
