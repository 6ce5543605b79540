//! Shared by all 3x3 convolution kernels: the layout of the weight, the input map, bias and ReLU.

use crate::Grid;
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
    /// For the convolution, or (`transposed`) for its gradient with respect to the input.
    pub(super) fn new(outputs: usize, inputs: usize, transposed: bool) -> Self {
        if transposed {
            Axes {
                inputs: outputs,
                outputs: inputs,
                input_step: 9 * inputs,
                output_step: 9,
                flipped: true,
            }
        } else {
            Axes {
                inputs,
                outputs,
                input_step: 9,
                output_step: 9 * inputs,
                flipped: false,
            }
        }
    }

    pub(super) fn place(self, input: usize, output: usize, tap: usize) -> usize {
        let tap = if self.flipped { 8 - tap } else { tap };
        input * self.input_step + output * self.output_step + tap
    }
}

/// A map to read; `gate` is the output of the ReLU that the gradient passes through.
#[derive(Clone, Copy)]
pub(super) struct GatedMap<'a> {
    pub(super) map: &'a [f32],
    pub(super) gate: Option<&'a [f32]>,
    pub(super) channels: usize,
}

impl<'a> GatedMap<'a> {
    /// A map without a gate.
    pub(super) fn open(map: &'a [f32], channels: usize) -> Self {
        GatedMap {
            map,
            gate: None,
            channels,
        }
    }
}

#[derive(Clone, Copy)]
pub(super) struct BiasRelu<'a> {
    pub(super) bias: Option<&'a [f32]>,
    pub(super) relu: bool,
}

impl BiasRelu<'_> {
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

/// What a convolution reads, beside its epilogue.
#[derive(Clone, Copy)]
pub(crate) struct ThinConvolution<'a> {
    /// Grid of `source`.
    pub(crate) grid: Grid,
    pub(crate) source: GatedMap<'a>,
    pub(crate) weight: &'a [f32],
    pub(crate) axes: Axes,
}
