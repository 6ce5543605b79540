//! The 3x3 convolution with padding 1: bias and ReLU fused, and its gradients.
//!
//! Wide layers go through `winograd`, those with few channels on one side through `thin`.

mod parts;
#[cfg(test)]
mod tests;
mod thin;
mod winograd;

use crate::{Grid, Isa};
use parts::{Axes, Finish};

/// Tiles of the Winograd transforms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tile {
    /// F(2x2, 3x3): 2.25 times fewer multiplications, as exact as the plain sum. For training.
    F2,
    /// F(4x4, 3x3): 4 times fewer, within 2e-5 of the largest value. For inference.
    F4,
}

/// Channels from which on Winograd's transforms pay.
const WINOGRAD_CHANNELS: usize = 8;

/// Input side of a Winograd tile in training: F(2x2, 3x3), as exact as the plain sum.
const TILE: usize = 4;

fn is_wide(inputs: usize, outputs: usize) -> bool {
    inputs.min(outputs) >= WINOGRAD_CHANNELS
}

/// `y = x * weight + bias`, rectified where `relu`.
///
/// # Shapes
/// `x` `[B, H, W, in]`, `weight` `[out, in, 3, 3]`, `bias` `[out]`, `y` `[B, H, W, out]`.
///
/// # Panics
/// Where the lengths do not fit.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub fn forward(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    relu: bool,
    y: &mut [f32],
) {
    forward_with(isa, Tile::F2, grid, x, weight, bias, relu, y);
}

/// [`forward`] with tiles of a given size.
///
/// # Panics
/// Where the lengths do not fit.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub fn forward_with(
    isa: Isa,
    tile: Tile,
    grid: Grid,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    relu: bool,
    y: &mut [f32],
) {
    check(grid, x.len(), weight.len(), bias.len(), y.len());
    Ready::new(isa, tile, weight, bias, relu).forward(grid, x, 0, y);
}

/// A convolution whose weights are prepared once, for maps that come in bands of rows.
pub struct Ready<'a> {
    isa: Isa,
    weights: Weights<'a>,
    finish: Finish<'a>,
    inputs: usize,
    outputs: usize,
}

/// As the kernel of their channels takes them.
enum Weights<'a> {
    Thin(&'a [f32]),
    F2(winograd::Weights),
    F4(winograd::Weights),
}

impl<'a> Ready<'a> {
    /// Of `weight` `[out, in, 3, 3]` and `bias` `[out]`, rectified where `relu`.
    ///
    /// # Panics
    /// Where the lengths do not fit.
    pub fn new(isa: Isa, tile: Tile, weight: &'a [f32], bias: &'a [f32], relu: bool) -> Self {
        let outputs = bias.len();
        let inputs = weight.len() / (9 * outputs);
        assert_eq!(
            weight.len(),
            outputs * inputs * 9,
            "a weight of {inputs} to {outputs} channels"
        );
        let weights = match tile {
            _ if !is_wide(inputs, outputs) => Weights::Thin(weight),
            Tile::F2 => Weights::F2(winograd::Weights::new::<4>(
                isa, weight, outputs, inputs, false,
            )),
            Tile::F4 => Weights::F4(winograd::Weights::new::<6>(
                isa, weight, outputs, inputs, false,
            )),
        };
        let finish = Finish {
            bias: Some(bias),
            relu,
        };
        Ready {
            isa,
            weights,
            finish,
            inputs,
            outputs,
        }
    }

    /// Input channels.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Output channels.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Convolves the rows of `x` from `above` on, as many as `y` has. Beyond the rows of `x` are zeros: where an image
    /// goes on there, `x` holds a row more than `y` on that side. The same bits as of a whole image where a band begins at
    /// a multiple of 4 rows and has one, or ends with the image.
    ///
    /// # Shapes
    /// `x` `[B, H, W, in]` with its `grid`, `y` `[B, rows, W, out]`; several images only where `y` has all rows.
    ///
    /// # Panics
    /// Where the lengths do not fit.
    pub fn forward(&self, grid: Grid, x: &[f32], above: usize, y: &mut [f32]) {
        assert_eq!(
            x.len(),
            grid.pixels() * self.inputs,
            "a map of {} channels on {grid:?}",
            self.inputs
        );
        let row = grid.batch * grid.width * self.outputs;
        assert!(
            y.len().is_multiple_of(row),
            "an output of {} channels on {grid:?}",
            self.outputs
        );
        match &self.weights {
            Weights::Thin(weight) => {
                let axes = Axes::new(self.outputs, self.inputs, false);
                thin::convolve(self.isa, grid, x, None, above, weight, axes, self.finish, y);
            }
            Weights::F2(weights) => {
                winograd::convolve_rows::<4>(grid, x, None, above, weights, self.finish, y)
            }
            Weights::F4(weights) => {
                winograd::convolve_rows::<6>(grid, x, None, above, weights, self.finish, y)
            }
        }
    }
}

/// Gradients of [`forward`] for `dy`, the gradient by `y`: `dx` where asked for, `dweight`, `dbias`, all overwritten.
///
/// `y` is the output where it was rectified: `dy` then counts where `y` is positive.
///
/// # Shapes
/// As in [`forward`]; a gradient has the shape of its value.
///
/// # Panics
/// Where the lengths do not fit.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub fn backward(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    weight: &[f32],
    y: Option<&[f32]>,
    dy: &[f32],
    dx: Option<&mut [f32]>,
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
    let (inputs, outputs) = check(grid, x.len(), weight.len(), dbias.len(), dy.len());
    assert_eq!(dweight.len(), weight.len(), "a weight's gradient");
    assert!(
        y.is_none_or(|y| y.len() == dy.len()),
        "an output of {} values",
        dy.len()
    );
    if let Some(dx) = &dx {
        assert_eq!(dx.len(), x.len(), "an input's gradient");
    }
    let nothing = Finish {
        bias: None,
        relu: false,
    };
    if is_wide(inputs, outputs) {
        if let Some(dx) = dx {
            let weights = winograd::Weights::new::<TILE>(isa, weight, outputs, inputs, true);
            winograd::convolve::<TILE>(grid, dy, y, &weights, nothing, dx);
        }
        winograd::gradient::<TILE>(isa, grid, x, dy, y, dweight, dbias);
    } else {
        if let Some(dx) = dx {
            let axes = Axes::new(outputs, inputs, true);
            thin::convolve(isa, grid, dy, y, 0, weight, axes, nothing, dx);
        }
        thin::gradient(isa, grid, x, dy, y, dweight, dbias);
    }
}

/// Input and output channels.
fn check(grid: Grid, x: usize, weight: usize, outputs: usize, y: usize) -> (usize, usize) {
    let inputs = grid.channels(x);
    assert_eq!(
        y,
        grid.pixels() * outputs,
        "an output of {outputs} channels on {grid:?}"
    );
    assert_eq!(
        weight,
        outputs * inputs * 9,
        "a weight of {inputs} to {outputs} channels"
    );
    (inputs, outputs)
}
