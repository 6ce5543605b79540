//! The 1x1 convolution over one or several maps side by side, without building their concatenation
//! (Eq. 2).

use rayon::prelude::*;

use crate::product::padded_rows;
use crate::rows::{self, BLOCK, Copy, Outer, Packed, PaddedRows, Term, copy, whole};
use crate::scratch::Scratch;
use crate::{Grid, Isa};

/// `y = [xs] * weight + bias`, rectified if `relu`.
///
/// # Shapes
/// `xs` `[B, H, W, in_i]` each, `weight` `[out, in]` with `in` the sum of all, `bias` `[out]`, `y`
/// `[B, H, W, out]`.
///
/// # Panics
/// If a length does not match the others.
pub fn forward(
    isa: Isa,
    grid: Grid,
    xs: &[&[f32]],
    weight: &[f32],
    bias: &[f32],
    relu: bool,
    y: &mut [f32],
) {
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

/// Operations on the sum of [`part`].
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue<'a> {
    /// Added to each channel.
    pub bias: Option<&'a [f32]>,
    /// Apply ReLU to the result.
    pub relu: bool,
    /// Add the previous content of `y` before bias and ReLU.
    pub add: bool,
}

/// A part of a 1x1 convolution, for inference: `y = epilogue([xs] * W + y)`. W holds the inputs of
/// `weight` from `first` on.
///
/// The convolution is linear up to its ReLU, so its inputs can be added one by one and need not be
/// in memory together.
///
/// # Shapes
/// `xs` `[B, H, W, in_i]` each, `weight` `[out, in]` with `first` and the sum of all `in_i` at most
/// `in`, `y` `[B, H, W, out]`.
///
/// # Panics
/// If a length does not match the others.
pub fn part(
    isa: Isa,
    grid: Grid,
    xs: &[&[f32]],
    weight: &[f32],
    first: usize,
    epilogue: Epilogue,
    y: &mut [f32],
) {
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

/// Gradients of [`forward`]. `dy` is the gradient with respect to `y`. Writes the requested
/// gradients of `xs`, `dweight` and `dbias`.
///
/// If the output was rectified, `y` is that output, and `dy` counts only where `y` is positive.
///
/// # Shapes
/// As in [`forward`]; a gradient has the shape of its value.
///
/// # Panics
/// If a length does not match the others.
#[allow(clippy::too_many_arguments, reason = "the operands of a convolution")]
pub fn backward(
    isa: Isa,
    grid: Grid,
    xs: &[&[f32]],
    weight: &[f32],
    y: Option<&[f32]>,
    dy: &[f32],
    dxs: &mut [Option<&mut [f32]>],
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
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

    // The gated gradient with rows padded to whole vectors, and its sums over blocks.
    let mut gated = Scratch::take(pixels * wide);
    let mut biases = vec![0.0f64; pixels.div_ceil(BLOCK) * outputs];
    gated
        .par_chunks_mut(BLOCK * wide)
        .zip(biases.par_chunks_mut(outputs))
        .enumerate()
        .for_each(|(task, (gated, sums))| {
            let (first, count) = (task * BLOCK * outputs, gated.len() / wide);
            copy(
                isa,
                Copy {
                    from: &dy[first..],
                    from_step: outputs,
                    gate: y.map(|y| &y[first..]),
                    bias: None,
                    relu: false,
                    target: gated,
                    target_step: wide,
                    rows: count,
                    channels: outputs,
                },
            );
            rows::column_sums(isa, gated, wide, count, outputs, sums);
        });
    for (o, dbias) in dbias.iter_mut().enumerate() {
        *dbias = biases[o..].iter().step_by(outputs).sum::<f64>() as f32;
    }

    for ((dx, &(first, count)), x) in dxs.iter_mut().zip(&inputs).zip(xs) {
        let Some(dx) = dx else { continue };
        assert_eq!(dx.len(), x.len(), "an input's gradient");
        let transposed = Packed::new(isa, outputs, count, |o, i| weight[o * total + first + i]);
        dx.par_chunks_mut(BLOCK * count)
            .enumerate()
            .for_each(|(task, dx)| {
                let rows = dx.len() / count;
                let window = PaddedRows::new(&gated, wide, task * BLOCK, rows);
                let c_step = whole(count);
                let mut c = Scratch::take(padded_rows(rows) * c_step);
                let term = Term {
                    rows: window.rows(),
                    step: wide,
                    weight: &transposed,
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

    for (x, &(first, count)) in xs.iter().zip(&inputs) {
        // Blocks of rows read past the last pixels, so those pixels are processed from a padded
        // copy.
        let outer = |a, b, pixels| Outer {
            a,
            a_step: count,
            rows: count,
            b,
            b_step: wide,
            columns: outputs,
            pixels,
        };
        let mut products = Vec::with_capacity(2);
        if pixels > 1 + 24_usize.div_ceil(count) {
            let tail = 24_usize.div_ceil(count) + 1;
            let body = pixels - tail;
            products.push(rows::outer(isa, &[outer(x, &gated, body)], wide));
            let end = PaddedRows::new(x, count, body, tail);
            products.push(rows::outer(
                isa,
                &[outer(end.rows(), &gated[body * wide..], tail)],
                wide,
            ));
        } else {
            let all = PaddedRows::new(x, count, 0, pixels);
            products.push(rows::outer(isa, &[outer(all.rows(), &gated, pixels)], wide));
        }
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
