//! The 3x3 convolution with padding 1: bias and ReLU fused, and its gradients.
//!
//! Wide layers use `winograd`; layers with few channels on one side use `thin`.

mod parts;
#[cfg(test)]
mod tests;
mod thin;
mod winograd;

use crate::operands::check_lengths;
use crate::{Convolution, GradientSource, GradientTarget, Grid, Isa};
use parts::{Axes, BiasRelu, GatedMap, ThinConvolution};

/// Tiles of the Winograd transforms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tile {
    /// F(2x2, 3x3): 2.25 times fewer multiplications, as exact as the plain sum. Used for training.
    F2,
    /// F(4x4, 3x3): 4 times fewer multiplications, within 2e-5 of the largest value. Used for
    /// inference.
    F4,
}

/// Minimum number of channels for which the Winograd transforms pay off.
const WINOGRAD_CHANNELS: usize = 8;

/// Input side of a Winograd tile in training: F(2x2, 3x3), as exact as the plain sum.
const TILE: usize = 4;

fn is_wide(inputs: usize, outputs: usize) -> bool {
    inputs.min(outputs) >= WINOGRAD_CHANNELS
}

/// `y = x * weight + bias`, rectified if `convolution.relu`.
///
/// # Shapes
/// `x` `[B, H, W, in]`, `weight` `[out, in, 3, 3]`, `y` `[B, H, W, out]`.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, x: &[f32], convolution: Convolution, y: &mut [f32]) {
    let Convolution { weight, bias, .. } = convolution;
    check_lengths(grid, [x.len(), y.len()], weight.len(), bias.len(), 9);
    PreparedConvolution::new(isa, Tile::F2, convolution).forward(grid, x, 0, y);
}

/// A convolution whose weights are prepared once, for maps that come in bands of rows.
pub struct PreparedConvolution<'a> {
    isa: Isa,
    weights: PreparedWeights<'a>,
    epilogue: BiasRelu<'a>,
    inputs: usize,
    outputs: usize,
}

enum PreparedWeights<'a> {
    Thin(&'a [f32]),
    F2(winograd::WinogradWeights),
    F4(winograd::WinogradWeights),
}

impl<'a> PreparedConvolution<'a> {
    /// Prepares a convolution with a weight `[out, in, 3, 3]`.
    ///
    /// # Panics
    /// If a length does not match the others.
    pub fn new(isa: Isa, tile: Tile, convolution: Convolution<'a>) -> Self {
        let Convolution { weight, bias, relu } = convolution;
        let outputs = bias.len();
        let inputs = weight.len() / (9 * outputs);
        assert_eq!(
            weight.len(),
            outputs * inputs * 9,
            "a weight of {inputs} to {outputs} channels"
        );
        let wide = isa.for_channels(inputs.max(outputs));
        let weights = match tile {
            _ if !is_wide(inputs, outputs) => PreparedWeights::Thin(weight),
            Tile::F2 => PreparedWeights::F2(winograd::WinogradWeights::new::<4>(
                wide, weight, outputs, inputs, false,
            )),
            Tile::F4 => PreparedWeights::F4(winograd::WinogradWeights::new::<6>(
                wide, weight, outputs, inputs, false,
            )),
        };
        let epilogue = BiasRelu {
            bias: Some(bias),
            relu,
        };
        PreparedConvolution {
            isa,
            weights,
            epilogue,
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

    /// Convolves the rows of `x` from `above` on, as many as `y` has. Outside `x` the input is
    /// zero. Where the image continues, `x` must hold one more row than `y` on that side.
    ///
    /// The bits equal those of a whole image for a band that starts at a multiple of 4 rows. Its
    /// height must also be a multiple of 4, unless it ends with the image.
    ///
    /// # Shapes
    /// `x` `[B, H, W, in]` with its `grid`, `y` `[B, rows, W, out]`; several images only where `y`
    /// has all rows.
    ///
    /// # Panics
    /// If a length does not match the others.
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
        let (x, epilogue) = (GatedMap::open(x, self.inputs), self.epilogue);
        match &self.weights {
            PreparedWeights::Thin(weight) => {
                let operands = ThinConvolution {
                    grid,
                    source: x,
                    weight,
                    axes: Axes::new(self.outputs, self.inputs, false),
                };
                thin::convolve(self.isa, operands, above, epilogue, y);
            }
            PreparedWeights::F2(weights) => {
                winograd::convolve_rows::<4>(grid, x, above, weights, epilogue, y)
            }
            PreparedWeights::F4(weights) => {
                winograd::convolve_rows::<6>(grid, x, above, weights, epilogue, y)
            }
        }
    }
}

/// Gradients of [`forward`]. Overwrites all of `target`.
///
/// # Panics
/// If a length does not match the others.
pub fn backward(isa: Isa, grid: Grid, x: &[f32], source: GradientSource, target: GradientTarget) {
    let GradientSource { weight, y, dy } = source;
    let GradientTarget { dx, dweight, dbias } = target;
    let outputs = dbias.len();
    let inputs = check_lengths(grid, [x.len(), dy.len()], weight.len(), outputs, 9);
    assert_eq!(dweight.len(), weight.len(), "a weight's gradient");
    assert!(
        y.is_none_or(|y| y.len() == dy.len()),
        "an output of {} values",
        dy.len()
    );
    if let Some(dx) = &dx {
        assert_eq!(dx.len(), x.len(), "an input's gradient");
    }
    let x = GatedMap::open(x, inputs);
    let dy = GatedMap {
        map: dy,
        gate: y,
        channels: outputs,
    };
    let nothing = BiasRelu {
        bias: None,
        relu: false,
    };
    if is_wide(inputs, outputs) {
        if let Some(dx) = dx {
            let weights =
                winograd::WinogradWeights::new::<TILE>(isa, weight, outputs, inputs, true);
            winograd::convolve::<TILE>(grid, dy, &weights, nothing, dx);
        }
        winograd::gradient::<TILE>(isa, grid, x, dy, dweight, dbias);
    } else {
        if let Some(dx) = dx {
            let operands = ThinConvolution {
                grid,
                source: dy,
                weight,
                axes: Axes::new(outputs, inputs, true),
            };
            thin::convolve(isa, operands, 0, nothing, dx);
        }
        thin::gradient(isa, grid, x, dy, dweight, dbias);
    }
}
