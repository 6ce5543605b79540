//! What all ways to a 3x3 convolution share: how its weight is read, which map, and what happens to the result.

use crate::simd::Simd;

/// How the axes of a weight `[out, in, 3, 3]` are read.
#[derive(Clone, Copy)]
pub(super) struct Axes {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    input_step: usize,
    output_step: usize,
    flipped: bool,
}

impl Axes {
    /// As the convolution reads them, or (`transposed`) its gradient by the input.
    pub(super) fn new(outputs: usize, inputs: usize, transposed: bool) -> Self {
        match transposed {
            false => Axes {
                inputs,
                outputs,
                input_step: 9,
                output_step: 9 * inputs,
                flipped: false,
            },
            true => Axes {
                inputs: outputs,
                outputs: inputs,
                input_step: 9 * inputs,
                output_step: 9,
                flipped: true,
            },
        }
    }

    /// Place of the weight from `input` to `output` at `tap`.
    pub(super) fn place(self, input: usize, output: usize, tap: usize) -> usize {
        let tap = if self.flipped { 8 - tap } else { tap };
        input * self.input_step + output * self.output_step + tap
    }
}

/// A map to read, gated by another one where the gradient comes through a ReLU.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub(super) map: &'a [f32],
    pub(super) gate: Option<&'a [f32]>,
    pub(super) channels: usize,
}

/// What happens to the result of a convolution: bias, ReLU.
#[derive(Clone, Copy)]
pub(super) struct Finish<'a> {
    pub(super) bias: Option<&'a [f32]>,
    pub(super) relu: bool,
}

impl Finish<'_> {
    /// The bias of `n` channels from `channel`.
    #[inline(always)]
    pub(super) unsafe fn bias<S: Simd>(&self, channel: usize, n: usize) -> S::V {
        // SAFETY: `n` values are there; the caller has the path of `S`.
        unsafe {
            match self.bias {
                Some(bias) => S::load_part(bias[channel..channel + n].as_ptr(), n),
                None => S::zero(),
            }
        }
    }
}
