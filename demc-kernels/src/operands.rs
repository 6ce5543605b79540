//! The operands of convolutions by name.

use crate::Grid;

/// A convolution and the ReLU after it.
///
/// # Shapes
/// `bias` `[out]`; `weight` as each kernel says.
#[derive(Clone, Copy, Debug)]
pub struct Convolution<'a> {
    /// Weight.
    pub weight: &'a [f32],
    /// Bias.
    pub bias: &'a [f32],
    /// Whether the output is rectified.
    pub relu: bool,
}

impl<'a> Convolution<'a> {
    /// A convolution with a ReLU after it.
    pub fn rectified(weight: &'a [f32], bias: &'a [f32]) -> Self {
        Convolution {
            weight,
            bias,
            relu: true,
        }
    }
}

/// What the gradients of a convolution are computed from, beside its inputs.
///
/// # Shapes
/// `weight` as each kernel says; `y` and `dy` that of the output.
#[derive(Clone, Copy, Debug)]
pub struct GradientSource<'a> {
    /// Weight.
    pub weight: &'a [f32],
    /// The output, if it was rectified: `dy` counts only where it is positive.
    pub y: Option<&'a [f32]>,
    /// Gradient with respect to the output.
    pub dy: &'a [f32],
}

impl<'a> GradientSource<'a> {
    /// For a convolution with a ReLU after it, whose output is `y`.
    pub fn rectified(weight: &'a [f32], y: &'a [f32], dy: &'a [f32]) -> Self {
        GradientSource {
            weight,
            y: Some(y),
            dy,
        }
    }
}

/// Where the gradients of a convolution are written. Each has the shape of its value.
#[derive(Debug)]
pub struct GradientTarget<'a, X = Option<&'a mut [f32]>> {
    /// With respect to the input; one for each where there are several. `None`: not computed.
    pub dx: X,
    /// With respect to the weight.
    pub dweight: &'a mut [f32],
    /// With respect to the bias.
    pub dbias: &'a mut [f32],
}

/// The number of input channels of a convolution that keeps the size, with kernels of `taps` values.
/// `x` and `y` are the lengths of input and output.
///
/// # Panics
/// If a length does not match the others.
#[track_caller]
pub(crate) fn check_lengths(
    grid: Grid,
    [x, y]: [usize; 2],
    weight: usize,
    outputs: usize,
    taps: usize,
) -> usize {
    let inputs = grid.channels(x);
    assert_eq!(
        y,
        grid.pixels() * outputs,
        "an output of {outputs} channels on {grid:?}"
    );
    assert_eq!(
        weight,
        outputs * inputs * taps,
        "a weight of {inputs} to {outputs} channels"
    );
    inputs
}
