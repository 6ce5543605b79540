//! Rows of channels copied and summed through vectors.

use crate::Isa;
use crate::simd::{Leaf, Simd, WIDEST, run};

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
