//! The 3x3 convolution with padding 1: bias and ReLU fused, and its gradients.
//!
//! Wide layers go through `winograd`, those with few channels on one side through `thin`.

use crate::winograd::{self, Finish};
use crate::{Grid, Isa, thin};

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
                let axes = thin::Axes::new(self.outputs, self.inputs, false);
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
            let axes = thin::Axes::new(outputs, inputs, true);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference;
    use crate::testing::{assert_close, f64s, few, grids, pattern};

    #[test]
    fn equals_the_reference_on_every_path_at_odd_sizes() {
        for isa in Isa::available() {
            for (case, grid) in grids().into_iter().enumerate() {
                let cases = vec![
                    (3, 8),
                    (8, 8),
                    (9, 3),
                    (12, 5),
                    (1, 1),
                    (17, 33),
                    (20, 8),
                    (66, 16),
                ];
                for (inputs, outputs) in few(cases, 2) {
                    let x = pattern(grid.pixels() * inputs, 1 + case as u32);
                    let weight = pattern(outputs * inputs * 9, 2);
                    let bias = pattern(outputs, 3);
                    let dy = pattern(grid.pixels() * outputs, 4);
                    for relu in [false, true] {
                        let name = format!("{isa} {grid:?} {inputs} to {outputs}");
                        let mut y = vec![f32::NAN; dy.len()];
                        forward(isa, grid, &x, &weight, &bias, relu, &mut y);
                        let expected =
                            reference::conv3x3(grid, &f64s(&x), &f64s(&weight), &f64s(&bias), relu);
                        assert_close(&format!("{name} y"), &y, &expected);

                        let gate = relu.then_some(&y[..]);
                        let gated = match gate {
                            Some(y) => reference::gated(&f64s(&dy), &f64s(y)),
                            None => f64s(&dy),
                        };
                        let expected =
                            reference::conv3x3_backward(grid, &f64s(&x), &f64s(&weight), &gated);
                        let mut dx = vec![f32::NAN; x.len()];
                        let mut dweight = vec![f32::NAN; weight.len()];
                        let mut dbias = vec![f32::NAN; outputs];
                        backward(
                            isa,
                            grid,
                            &x,
                            &weight,
                            gate,
                            &dy,
                            Some(&mut dx),
                            &mut dweight,
                            &mut dbias,
                        );
                        assert_close(&format!("{name} dx"), &dx, &expected.dx);
                        assert_close(&format!("{name} dweight"), &dweight, &expected.dweight);
                        assert_close(&format!("{name} dbias"), &dbias, &expected.dbias);
                    }
                }
            }
        }
    }

    #[test]
    fn bands_of_rows_are_the_whole() {
        let grid = Grid {
            batch: 1,
            height: 23,
            width: 9,
        };
        for isa in Isa::available() {
            for (inputs, outputs) in [(3, 20), (20, 3), (18, 33)] {
                let (x, weight) = (
                    pattern(grid.pixels() * inputs, 1),
                    pattern(outputs * inputs * 9, 2),
                );
                let bias = pattern(outputs, 3);
                for tile in [Tile::F2, Tile::F4] {
                    let mut whole = vec![f32::NAN; grid.pixels() * outputs];
                    forward_with(isa, tile, grid, &x, &weight, &bias, true, &mut whole);
                    let ready = Ready::new(isa, tile, &weight, &bias, true);
                    let mut bands = vec![f32::NAN; whole.len()];
                    for (first, end) in [(0, 4), (4, 16), (16, 23)] {
                        let (from, to) =
                            (usize::saturating_sub(first, 1), (end + 1).min(grid.height));
                        let row = grid.width * inputs;
                        let y =
                            &mut bands[first * grid.width * outputs..end * grid.width * outputs];
                        let band = Grid {
                            height: to - from,
                            ..grid
                        };
                        ready.forward(band, &x[from * row..to * row], first - from, y);
                    }
                    let differs = |i: &usize| bands[*i].to_bits() != whole[*i].to_bits();
                    let at = (0..whole.len())
                        .find(differs)
                        .map(|i| (i / outputs, bands[i], whole[i]));
                    assert!(
                        at.is_none(),
                        "{isa} {inputs} to {outputs} {tile:?}: pixel, found, expected: {at:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn larger_tiles_keep_1e_4() {
        for isa in Isa::available() {
            for grid in grids() {
                let (inputs, outputs) = if cfg!(miri) { (9, 8) } else { (64, 17) };
                let x = pattern(grid.pixels() * inputs, 1);
                let weight = pattern(outputs * inputs * 9, 2);
                let bias = pattern(outputs, 3);
                let weights = winograd::Weights::new::<6>(isa, &weight, outputs, inputs, false);
                let mut y = vec![f32::NAN; grid.pixels() * outputs];
                winograd::convolve::<6>(
                    grid,
                    &x,
                    None,
                    &weights,
                    Finish {
                        bias: Some(&bias),
                        relu: true,
                    },
                    &mut y,
                );
                let expected =
                    reference::conv3x3(grid, &f64s(&x), &f64s(&weight), &f64s(&bias), true);
                crate::testing::assert_within(&format!("{isa} {grid:?}"), &y, &expected, 2e-5);
            }
        }
    }
}
