//! The operations as plain loops in float64. Only tests use them.
//!
//! Maps have their channels last; weights have the layout of weight files.

use crate::Grid;

/// Gradients of a convolution.
pub struct Gradients {
    /// With respect to the input.
    pub dx: Vec<f64>,
    /// With respect to the weight.
    pub dweight: Vec<f64>,
    /// With respect to the bias.
    pub dbias: Vec<f64>,
}

/// `(output pixel, input pixel, tap)` of a 3x3 convolution with padding 1, tap = 3 * row + column.
fn taps3x3(grid: Grid) -> impl Iterator<Item = (usize, usize, usize)> {
    let Grid {
        batch,
        height,
        width,
    } = grid;
    (0..batch * height * width).flat_map(move |out| {
        let (b, y, x) = (out / (height * width), out / width % height, out % width);
        (0..9).filter_map(move |tap| {
            let (iy, ix) = ((y + tap / 3).checked_sub(1)?, (x + tap % 3).checked_sub(1)?);
            (iy < height && ix < width).then_some((out, (b * height + iy) * width + ix, tap))
        })
    })
}

/// The same for a 4x4 deconvolution of a `grid` with stride 2 and padding 1, tap = 4 * row +
/// column.
fn taps4x4(grid: Grid) -> impl Iterator<Item = (usize, usize, usize)> {
    let Grid {
        batch,
        height,
        width,
    } = grid;
    (0..batch * height * width).flat_map(move |input| {
        let (b, y, x) = (
            input / (height * width),
            input / width % height,
            input % width,
        );
        (0..16).filter_map(move |tap| {
            let (oy, ox) = (
                (2 * y + tap / 4).checked_sub(1)?,
                (2 * x + tap % 4).checked_sub(1)?,
            );
            (oy < 2 * height && ox < 2 * width).then_some((
                (b * 2 * height + oy) * 2 * width + ox,
                input,
                tap,
            ))
        })
    })
}

fn rectified(mut y: Vec<f64>, relu: bool) -> Vec<f64> {
    if relu {
        y.iter_mut().for_each(|y| *y = y.max(0.0));
    }
    y
}

/// A convolution over `(out, in, tap)` triples; `index(o, i, tap)` is the index of a weight.
fn forward(
    taps: impl Iterator<Item = (usize, usize, usize)>,
    out_pixels: usize,
    x: &[f64],
    inputs: usize,
    weight: &[f64],
    bias: &[f64],
    index: impl Fn(usize, usize, usize) -> usize,
) -> Vec<f64> {
    let outputs = bias.len();
    let mut y: Vec<f64> = (0..out_pixels * outputs)
        .map(|i| bias[i % outputs])
        .collect();
    for (out, input, tap) in taps {
        for o in 0..outputs {
            for i in 0..inputs {
                y[out * outputs + o] += weight[index(o, i, tap)] * x[input * inputs + i];
            }
        }
    }
    y
}

/// The gradients of [`forward`]; `dy` is the gradient with respect to its output before any ReLU.
fn backward(
    taps: impl Iterator<Item = (usize, usize, usize)>,
    x: &[f64],
    inputs: usize,
    weight: &[f64],
    dy: &[f64],
    outputs: usize,
    index: impl Fn(usize, usize, usize) -> usize,
) -> Gradients {
    let mut g = Gradients {
        dx: vec![0.0; x.len()],
        dweight: vec![0.0; weight.len()],
        dbias: vec![0.0; outputs],
    };
    for (i, dy) in dy.iter().enumerate() {
        g.dbias[i % outputs] += dy;
    }
    for (out, input, tap) in taps {
        for o in 0..outputs {
            for i in 0..inputs {
                let offset = index(o, i, tap);
                let dy = dy[out * outputs + o];
                g.dx[input * inputs + i] += weight[offset] * dy;
                g.dweight[offset] += x[input * inputs + i] * dy;
            }
        }
    }
    g
}

/// `dy` where `y` is positive, 0 elsewhere: the gradient before a ReLU whose output is `y`.
pub fn gated(dy: &[f64], y: &[f64]) -> Vec<f64> {
    dy.iter()
        .zip(y)
        .map(|(dy, y)| if *y > 0.0 { *dy } else { 0.0 })
        .collect()
}

/// 3x3 convolution, padding 1, weight `[out, in, 3, 3]`.
pub fn conv3x3(grid: Grid, x: &[f64], weight: &[f64], bias: &[f64], relu: bool) -> Vec<f64> {
    let inputs = grid.channels(x.len());
    let index = |o, i, tap| (o * inputs + i) * 9 + tap;
    rectified(
        forward(taps3x3(grid), grid.pixels(), x, inputs, weight, bias, index),
        relu,
    )
}

/// Gradients of [`conv3x3`].
pub fn conv3x3_backward(grid: Grid, x: &[f64], weight: &[f64], dy: &[f64]) -> Gradients {
    let (inputs, outputs) = (grid.channels(x.len()), grid.channels(dy.len()));
    backward(
        taps3x3(grid),
        x,
        inputs,
        weight,
        dy,
        outputs,
        |o, i, tap| (o * inputs + i) * 9 + tap,
    )
}

/// 1x1 convolution, weight `[out, in]`.
pub fn conv1x1(grid: Grid, x: &[f64], weight: &[f64], bias: &[f64], relu: bool) -> Vec<f64> {
    let inputs = grid.channels(x.len());
    let taps = (0..grid.pixels()).map(|p| (p, p, 0));
    let index = |o, i, _| o * inputs + i;
    rectified(
        forward(taps, grid.pixels(), x, inputs, weight, bias, index),
        relu,
    )
}

/// Gradients of [`conv1x1`].
pub fn conv1x1_backward(grid: Grid, x: &[f64], weight: &[f64], dy: &[f64]) -> Gradients {
    let (inputs, outputs) = (grid.channels(x.len()), grid.channels(dy.len()));
    let taps = (0..grid.pixels()).map(|p| (p, p, 0));
    backward(taps, x, inputs, weight, dy, outputs, |o, i, _| {
        o * inputs + i
    })
}

/// 4x4 deconvolution, stride 2, padding 1, weight `[in, out, 4, 4]`, from `grid` to
/// `grid.doubled()`.
pub fn deconv4x4(grid: Grid, x: &[f64], weight: &[f64], bias: &[f64], relu: bool) -> Vec<f64> {
    let (inputs, outputs) = (grid.channels(x.len()), bias.len());
    let index = |o, i, tap| (i * outputs + o) * 16 + tap;
    let pixels = grid.doubled().pixels();
    rectified(
        forward(taps4x4(grid), pixels, x, inputs, weight, bias, index),
        relu,
    )
}

/// Gradients of [`deconv4x4`].
pub fn deconv4x4_backward(grid: Grid, x: &[f64], weight: &[f64], dy: &[f64]) -> Gradients {
    let (inputs, outputs) = (grid.channels(x.len()), grid.doubled().channels(dy.len()));
    backward(
        taps4x4(grid),
        x,
        inputs,
        weight,
        dy,
        outputs,
        |o, i, tap| (i * outputs + o) * 16 + tap,
    )
}
