//! The 5x5 convolution with padding 2 (KPCN, Bako et al. 2017): bias and ReLU fused, and its gradients.
//!
//! The input is copied once, with zeros around it. Five neighbours of a row then lie side by side, so a
//! row of the kernel is one product, five times as deep as the input has channels.

mod padded;
#[cfg(test)]
mod tests;

use rayon::prelude::*;

use crate::operands::check_lengths;
use crate::rows::{self, BLOCK, Outer, Packed, Term, whole};
use crate::{Convolution, GradientSource, GradientTarget, Grid, Isa};
use padded::{PaddedMap, SIDE};

/// Weights of a kernel.
const TAPS: usize = SIDE * SIDE;

/// `y = x * weight + bias`, rectified if `convolution.relu`.
///
/// # Shapes
/// `x` `[B, H, W, in]`, `weight` `[out, in, 5, 5]`, `y` `[B, H, W, out]`.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, x: &[f32], convolution: Convolution, y: &mut [f32]) {
    let Convolution { weight, bias, relu } = convolution;
    let outputs = bias.len();
    let inputs = check_lengths(grid, [x.len(), y.len()], weight.len(), outputs, TAPS);
    let isa = isa.for_channels(outputs);
    let x = PaddedMap::new(isa, grid, x, None, [inputs, inputs]);
    let weights = kernel_rows(isa, inputs, outputs, |input, output, tap| {
        weight[(output * inputs + input) * TAPS + tap]
    });
    convolve(isa, &x, &weights, Some(bias), relu, y);
}

/// Gradients of [`forward`]. Overwrites all of `target`.
///
/// # Panics
/// If a length does not match the others.
pub fn backward(isa: Isa, grid: Grid, x: &[f32], source: GradientSource, target: GradientTarget) {
    let GradientSource { weight, y, dy } = source;
    let GradientTarget { dx, dweight, dbias } = target;
    let outputs = dbias.len();
    let inputs = check_lengths(grid, [x.len(), dy.len()], weight.len(), outputs, TAPS);
    assert_eq!(dweight.len(), weight.len(), "a weight's gradient");
    assert!(
        y.is_none_or(|y| y.len() == dy.len()),
        "an output of {} values",
        dy.len()
    );
    let wide = whole(outputs);
    let gated = PaddedMap::new(isa, grid, dy, y, [outputs, wide]);
    if let Some(dx) = dx {
        assert_eq!(dx.len(), x.len(), "an input's gradient");
        let isa = isa.for_channels(inputs);
        // The kernel turned by half a turn; the channels that fill up a vector count nothing.
        let weights = kernel_rows(isa, wide, inputs, |output, input, tap| {
            if output < outputs {
                weight[(output * inputs + input) * TAPS + TAPS - 1 - tap]
            } else {
                0.0
            }
        });
        convolve(isa, &gated, &weights, None, false, dx);
    }
    for (dbias, sum) in dbias.iter_mut().zip(gated.sums(isa, outputs)) {
        *dbias = sum as f32;
    }
    let x = PaddedMap::new(isa, grid, x, None, [inputs, inputs]);
    weight_gradient(isa, &x, &gated, dweight);
}

/// The weights of each row of the kernel, `[5 in, out]`: neighbour by neighbour, then channel by
/// channel. `value(input, output, tap)` is a weight.
fn kernel_rows(
    isa: Isa,
    inputs: usize,
    outputs: usize,
    value: impl Fn(usize, usize, usize) -> f32 + Sync,
) -> [Packed; SIDE] {
    std::array::from_fn(|row| {
        Packed::new(isa, SIDE * inputs, outputs, |k, output| {
            value(k % inputs, output, row * SIDE + k / inputs)
        })
    })
}

/// Convolves the rows of a padded map. Each row is cut into blocks of pixels.
fn convolve(
    isa: Isa,
    x: &PaddedMap,
    weights: &[Packed; SIDE],
    bias: Option<&[f32]>,
    relu: bool,
    y: &mut [f32],
) {
    let outputs = weights[0].columns();
    let width = x.grid.width;
    let blocks = y
        .chunks_mut(width * outputs)
        .enumerate()
        .flat_map(|(line, y)| {
            let blocks = y.chunks_mut(BLOCK * outputs).enumerate();
            blocks.map(move |(block, y)| (line, block * BLOCK, y))
        });
    let blocks: Vec<_> = blocks.collect();
    blocks.into_par_iter().for_each(|(line, column, y)| {
        let (image, row) = (line / x.grid.height, line % x.grid.height);
        let terms: [Term; SIDE] = std::array::from_fn(|kernel_row| Term {
            rows: x.from(image, row + kernel_row, column),
            step: x.step,
            weight: &weights[kernel_row],
        });
        rows::write_sum(isa, &terms, false, bias, relu, y);
    });
}

/// The sum over all pixels of an input pixel's neighbourhood times an output pixel's gradient.
fn weight_gradient(isa: Isa, x: &PaddedMap, gated: &PaddedMap, dweight: &mut [f32]) {
    let Grid {
        batch,
        height,
        width,
    } = x.grid;
    let (inputs, wide) = (x.step, gated.step);
    // All pixels from the first to the last, with the padding between the rows, whose gradient is 0.
    let pixels = (height - 1) * PaddedMap::width(x.grid) + width;
    let outers: Vec<Outer> = (0..batch)
        .flat_map(|image| (0..SIDE).map(move |row| (image, row)))
        .map(|(image, row)| Outer {
            a: x.from(image, row, 0),
            a_step: inputs,
            rows: SIDE * inputs,
            b: gated.from(image, SIDE / 2, SIDE / 2),
            b_step: wide,
            columns: wide,
            pixels,
        })
        .collect();
    let products = rows::outer(isa, &outers, wide);
    let size = products.len() / outers.len();
    dweight
        .par_chunks_mut(inputs * TAPS)
        .enumerate()
        .for_each(|(output, dweight)| {
            for (place, dweight) in dweight.iter_mut().enumerate() {
                let (input, tap) = (place / TAPS, place % TAPS);
                let line = tap % SIDE * inputs + input;
                let images = products.chunks_exact(size).skip(tap / SIDE).step_by(SIDE);
                *dweight = images.map(|product| product[line * wide + output]).sum();
            }
        });
}
