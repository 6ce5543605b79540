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

/// `(output pixel, input pixel, tap)` of a convolution that keeps the size, with a kernel of
/// `side` x `side`; tap = side * row + column.
fn taps(grid: Grid, side: usize) -> impl Iterator<Item = (usize, usize, usize)> {
    let Grid {
        batch,
        height,
        width,
    } = grid;
    (0..batch * height * width).flat_map(move |out| {
        let (b, y, x) = (out / (height * width), out / width % height, out % width);
        (0..side * side).filter_map(move |tap| {
            let iy = (y + tap / side).checked_sub(side / 2)?;
            let ix = (x + tap % side).checked_sub(side / 2)?;
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

/// Convolution that keeps the size, weight `[out, in, side, side]`.
fn convolution(
    grid: Grid,
    side: usize,
    x: &[f64],
    weight: &[f64],
    bias: &[f64],
    relu: bool,
) -> Vec<f64> {
    let inputs = grid.channels(x.len());
    let index = |o, i, tap| (o * inputs + i) * side * side + tap;
    let taps = taps(grid, side);
    rectified(
        forward(taps, grid.pixels(), x, inputs, weight, bias, index),
        relu,
    )
}

/// Gradients of [`convolution`].
fn convolution_backward(
    grid: Grid,
    side: usize,
    x: &[f64],
    weight: &[f64],
    dy: &[f64],
) -> Gradients {
    let (inputs, outputs) = (grid.channels(x.len()), grid.channels(dy.len()));
    let index = |o, i, tap| (o * inputs + i) * side * side + tap;
    backward(taps(grid, side), x, inputs, weight, dy, outputs, index)
}

/// 3x3 convolution, padding 1, weight `[out, in, 3, 3]`.
pub fn conv3x3(grid: Grid, x: &[f64], weight: &[f64], bias: &[f64], relu: bool) -> Vec<f64> {
    convolution(grid, 3, x, weight, bias, relu)
}

/// Gradients of [`conv3x3`].
pub fn conv3x3_backward(grid: Grid, x: &[f64], weight: &[f64], dy: &[f64]) -> Gradients {
    convolution_backward(grid, 3, x, weight, dy)
}

/// 5x5 convolution, padding 2, weight `[out, in, 5, 5]`.
pub fn conv5x5(grid: Grid, x: &[f64], weight: &[f64], bias: &[f64], relu: bool) -> Vec<f64> {
    convolution(grid, 5, x, weight, bias, relu)
}

/// Gradients of [`conv5x5`].
pub fn conv5x5_backward(grid: Grid, x: &[f64], weight: &[f64], dy: &[f64]) -> Gradients {
    convolution_backward(grid, 5, x, weight, dy)
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

/// Every pixel with its own square kernel, the softmax of its logits, border replicated. One more
/// logit becomes a fourth channel, its sigmoid.
pub fn filter(grid: Grid, x: &[f64], logits: &[f64]) -> Vec<f64> {
    let channels = grid.channels(logits.len());
    let side = channels.isqrt();
    let (reach, taps) = (side / 2, side * side);
    let Grid { height, width, .. } = grid;
    let mut out = Vec::new();
    for (pixel, logits) in logits.chunks(channels).enumerate() {
        let (image, row) = (pixel / (height * width), pixel / width % height);
        let weights: Vec<f64> = logits[..taps].iter().map(|logit| logit.exp()).collect();
        let sum: f64 = weights.iter().sum();
        for channel in 0..3 {
            let taps = weights.iter().enumerate().map(|(tap, weight)| {
                let y = (row + tap / side).saturating_sub(reach).min(height - 1);
                let x_at = (pixel % width + tap % side)
                    .saturating_sub(reach)
                    .min(width - 1);
                weight / sum * x[((image * height + y) * width + x_at) * 3 + channel]
            });
            out.push(taps.sum());
        }
        out.extend(
            logits[taps..]
                .iter()
                .map(|logit| 1.0 / (1.0 + (-logit).exp())),
        );
    }
    out
}

/// `y + b U(c - D(y))`: a filtered image of 4 channels, the last one `b`, and the coarser image `c`.
pub fn blend(grid: Grid, filtered: &[f64], coarse: &[f64]) -> Vec<f64> {
    let Grid { height, width, .. } = grid;
    let half = grid.halved();
    let mut correction = coarse.to_vec();
    for (i, value) in correction.iter_mut().enumerate() {
        let (pixel, channel) = (i / 3, i % 3);
        let image = pixel / (half.height * half.width);
        let (y, x) = (pixel / half.width % half.height, pixel % half.width);
        for (dy, dx) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let from = (image * height + 2 * y + dy) * width + 2 * x + dx;
            *value -= 0.25 * filtered[from * 4 + channel];
        }
    }
    // The position of a doubled pixel's centre among the halved ones, and the pixels around it.
    let around = |doubled: usize, length: usize| {
        let position = ((doubled as f64 + 0.5) / 2.0 - 0.5).clamp(0.0, (length - 1) as f64);
        let first = position.floor();
        let second = (first as usize + 1).min(length - 1);
        [
            (first as usize, 1.0 - (position - first)),
            (second, position - first),
        ]
    };
    let pixels = (0..grid.pixels()).flat_map(|pixel| {
        let image = pixel / (height * width);
        let (rows, columns) = (
            around(pixel / width % height, half.height),
            around(pixel % width, half.width),
        );
        let correction = &correction;
        (0..3).map(move |channel| {
            let mut doubled = 0.0;
            for (y, vertical) in rows {
                for (x, horizontal) in columns {
                    let from = (image * half.height + y) * half.width + x;
                    doubled += vertical * horizontal * correction[from * 3 + channel];
                }
            }
            filtered[pixel * 4 + channel] + filtered[pixel * 4 + 3] * doubled
        })
    });
    pixels.collect()
}
