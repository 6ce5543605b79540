//! The 1x1 convolution over one or several maps side by side, without building their concatenation
//! (Eq. 2).

use rayon::prelude::*;

use crate::product::padded_rows;
use crate::rows::{self, BLOCK, Copy, Outer, Packed, PaddedRows, Term, copy, whole};
use crate::scratch::Scratch;
use crate::{Convolution, GradientSource, GradientTarget, Grid, Isa};

/// `y = [xs] * weight + bias`, rectified if `convolution.relu`.
///
/// # Shapes
/// `xs` `[B, H, W, in_i]` each, `weight` `[out, in]` with `in` the sum of all, `y` `[B, H, W, out]`.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(isa: Isa, grid: Grid, xs: &[&[f32]], convolution: Convolution, y: &mut [f32]) {
    let Convolution { weight, bias, relu } = convolution;
    let (inputs, outputs) = (
        check(grid, xs, weight.len(), bias.len(), y.len()),
        bias.len(),
    );
    let isa = isa.for_channels(outputs);
    let total: usize = inputs.iter().map(|(_, count)| count).sum();
    let weights: Vec<Packed> = inputs
        .iter()
        .map(|&(first, count)| {
            Packed::new(isa, count, outputs, |k, o| weight[o * total + first + k])
        })
        .collect();
    products(
        isa,
        xs,
        &inputs,
        &weights,
        Epilogue {
            bias: Some(bias),
            relu,
            add: false,
        },
        y,
    );
}

/// Operations on the sum of [`forward_part`].
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue<'a> {
    /// Added to each channel.
    pub bias: Option<&'a [f32]>,
    /// Apply ReLU to the result.
    pub relu: bool,
    /// Add the previous content of `y` before bias and ReLU.
    pub add: bool,
}

/// A part of a 1x1 convolution, for [`forward_part`].
#[derive(Clone, Copy, Debug)]
pub struct Part<'a> {
    /// Weight of the whole convolution, `[out, in]`.
    pub weight: &'a [f32],
    /// The first of the part's inputs.
    pub first: usize,
    /// Operations on the sum.
    pub epilogue: Epilogue<'a>,
}

/// A part of a 1x1 convolution, for inference: `y = epilogue([xs] * W + y)`. W holds the inputs of
/// `weight` from `first` on.
///
/// The convolution is linear up to its ReLU, so its inputs can be added one by one and need not be
/// in memory together.
///
/// # Shapes
/// `xs` `[B, H, W, in_i]` each, `first` and the sum of all `in_i` at most `in`, `y` `[B, H, W, out]`.
///
/// # Panics
/// If a length does not match the others.
pub fn forward_part(isa: Isa, grid: Grid, xs: &[&[f32]], part: Part, y: &mut [f32]) {
    let Part {
        weight,
        first,
        epilogue,
    } = part;
    let outputs = grid.channels(y.len());
    let isa = isa.for_channels(outputs);
    let total = weight.len() / outputs;
    let inputs = widths(grid, xs);
    let end = first + inputs.iter().map(|(_, count)| count).sum::<usize>();
    assert!(
        weight.len() == total * outputs && end <= total,
        "inputs {first} to {end} of {total}"
    );
    assert!(
        epilogue.bias.is_none_or(|bias| bias.len() == outputs),
        "a bias of {outputs} channels"
    );
    let weights: Vec<Packed> = inputs
        .iter()
        .map(|&(offset, count)| {
            Packed::new(isa, count, outputs, |k, o| {
                weight[o * total + first + offset + k]
            })
        })
        .collect();
    products(isa, xs, &inputs, &weights, epilogue, y);
}

/// Sums the products of all maps with their weights and applies the epilogue.
fn products(
    isa: Isa,
    xs: &[&[f32]],
    inputs: &[(usize, usize)],
    weights: &[Packed],
    epilogue: Epilogue,
    y: &mut [f32],
) {
    let outputs = weights[0].columns();
    y.par_chunks_mut(BLOCK * outputs)
        .enumerate()
        .for_each(|(task, y)| {
            let (first, count) = (task * BLOCK, y.len() / outputs);
            let windows: Vec<PaddedRows> = xs
                .iter()
                .zip(inputs)
                .map(|(x, (_, step))| PaddedRows::new(x, *step, first, count))
                .collect();
            let terms: Vec<Term> = windows
                .iter()
                .zip(inputs)
                .zip(weights)
                .map(|((window, (_, step)), weight)| Term {
                    rows: window.rows(),
                    step: *step,
                    weight,
                })
                .collect();
            let Epilogue { bias, relu, add } = epilogue;
            rows::write_sum(isa, &terms, add, bias, relu, y);
        });
}

/// Gradients of [`forward`]. Overwrites `target`, and of the inputs' gradients the requested ones.
///
/// # Panics
/// If a length does not match the others.
pub fn backward(
    isa: Isa,
    grid: Grid,
    xs: &[&[f32]],
    source: GradientSource,
    target: GradientTarget<&mut [Option<&mut [f32]>]>,
) {
    let GradientSource { weight, y, dy } = source;
    let GradientTarget {
        dx: dxs,
        dweight,
        dbias,
    } = target;
    let (inputs, outputs) = (
        check(grid, xs, weight.len(), dbias.len(), dy.len()),
        dbias.len(),
    );
    assert_eq!(dweight.len(), weight.len(), "a weight's gradient");
    assert!(
        y.is_none_or(|y| y.len() == dy.len()),
        "an output of {} values",
        dy.len()
    );
    assert_eq!(xs.len(), dxs.len(), "a gradient, or none, for each input");
    let (total, pixels) = (
        inputs.iter().map(|(_, count)| count).sum::<usize>(),
        grid.pixels(),
    );

    let wide = whole(outputs);
    let (gated, sums) = gated_gradient(isa, y, dy, pixels, outputs);
    for (dbias, sum) in dbias.iter_mut().zip(sums) {
        *dbias = sum as f32;
    }
    for ((dx, &(first, count)), x) in dxs.iter_mut().zip(&inputs).zip(xs) {
        let Some(dx) = dx else { continue };
        assert_eq!(dx.len(), x.len(), "an input's gradient");
        let transposed = Packed::new(isa, outputs, count, |o, i| weight[o * total + first + i]);
        input_gradient(isa, &gated, &transposed, [outputs, count], dx);
    }
    for (x, &(first, count)) in xs.iter().zip(&inputs) {
        let products = weight_products(isa, x, &gated, [count, outputs], pixels);
        dweight
            .par_chunks_mut(total)
            .enumerate()
            .for_each(|(o, dweight)| {
                for (i, dweight) in dweight[first..first + count].iter_mut().enumerate() {
                    *dweight = products.iter().map(|product| product[i * wide + o]).sum();
                }
            });
    }
}

/// The gated gradient `[pixels, channels]` with rows padded to whole vectors, and its sum over all
/// pixels, for each channel.
fn gated_gradient(
    isa: Isa,
    y: Option<&[f32]>,
    dy: &[f32],
    pixels: usize,
    channels: usize,
) -> (Scratch, Vec<f64>) {
    let wide = whole(channels);
    let mut gated = Scratch::take(pixels * wide);
    let mut blocks = vec![0.0f64; pixels.div_ceil(BLOCK) * channels];
    gated
        .par_chunks_mut(BLOCK * wide)
        .zip(blocks.par_chunks_mut(channels))
        .enumerate()
        .for_each(|(task, (gated, sums))| {
            let (first, count) = (task * BLOCK * channels, gated.len() / wide);
            copy(
                isa,
                Copy {
                    from: &dy[first..],
                    from_step: channels,
                    gate: y.map(|y| &y[first..]),
                    bias: None,
                    relu: false,
                    target: gated,
                    target_step: wide,
                    rows: count,
                    channels,
                },
            );
            rows::column_sums(isa, gated, wide, count, channels, sums);
        });
    let sum = |channel: usize| blocks[channel..].iter().step_by(channels).sum();
    (gated, (0..channels).map(sum).collect())
}

/// `dx = gated * transposed`: the gradient of one input of `count` channels, from the gated gradient
/// of `outputs` channels with padded rows.
fn input_gradient(
    isa: Isa,
    gated: &[f32],
    transposed: &Packed,
    [outputs, count]: [usize; 2],
    dx: &mut [f32],
) {
    let (wide, c_step) = (whole(outputs), whole(count));
    dx.par_chunks_mut(BLOCK * count)
        .enumerate()
        .for_each(|(task, dx)| {
            let rows = dx.len() / count;
            let window = PaddedRows::new(gated, wide, task * BLOCK, rows);
            let mut c = Scratch::take(padded_rows(rows) * c_step);
            let term = Term {
                rows: window.rows(),
                step: wide,
                weight: transposed,
            };
            rows::sum(isa, rows, &[term], &mut c, c_step);
            copy(
                isa,
                Copy {
                    from: &c,
                    from_step: c_step,
                    gate: None,
                    bias: None,
                    relu: false,
                    target: dx,
                    target_step: count,
                    rows,
                    channels: count,
                },
            );
        });
}

/// Products `x^T * gated` over the pixels, whose sum is the gradient of the weight of one input:
/// `count` rows, each padded to whole vectors of `outputs`.
fn weight_products(
    isa: Isa,
    x: &[f32],
    gated: &[f32],
    [count, outputs]: [usize; 2],
    pixels: usize,
) -> Vec<Scratch> {
    let wide = whole(outputs);
    let product = |a: &[f32], b: &[f32], pixels| {
        let outer = Outer {
            a,
            a_step: count,
            rows: count,
            b,
            b_step: wide,
            columns: outputs,
            pixels,
        };
        rows::outer(isa, &[outer], wide)
    };
    // Blocks of rows read past the last pixels, so those pixels are processed from a padded copy.
    let tail = 24_usize.div_ceil(count) + 1;
    if pixels > tail {
        let body = pixels - tail;
        let end = PaddedRows::new(x, count, body, tail);
        vec![
            product(x, gated, body),
            product(end.rows(), &gated[body * wide..], tail),
        ]
    } else {
        let all = PaddedRows::new(x, count, 0, pixels);
        vec![product(all.rows(), gated, pixels)]
    }
}

fn widths(grid: Grid, xs: &[&[f32]]) -> Vec<(usize, usize)> {
    let mut first = 0;
    xs.iter()
        .map(|x| {
            let count = grid.channels(x.len());
            first += count;
            (first - count, count)
        })
        .collect()
}

/// As [`widths`], after checking all lengths.
fn check(
    grid: Grid,
    xs: &[&[f32]],
    weight: usize,
    outputs: usize,
    y: usize,
) -> Vec<(usize, usize)> {
    let inputs = widths(grid, xs);
    let first: usize = inputs.iter().map(|(_, count)| count).sum();
    assert_eq!(
        y,
        grid.pixels() * outputs,
        "an output of {outputs} channels on {grid:?}"
    );
    assert_eq!(
        weight,
        outputs * first,
        "a weight of {first} to {outputs} channels"
    );
    inputs
}

#[cfg(test)]
mod tests;
