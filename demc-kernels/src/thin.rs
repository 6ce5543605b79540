//! 3x3 convolutions with few channels on one side (the first and the last of the network), as plain sums.
//!
//! Few inputs: the 3x3 neighbourhood of a pixel becomes a row of `9 * in` values (*im2col*), and the convolution one
//! product. Few outputs would leave most lanes of a vector empty; there the product makes all `9 * out` values that a
//! pixel gives to its neighbours, which are then collected (*col2im*).

use rayon::prelude::*;

use crate::product::{Left, Panels, Right, padded_rows, product};
use crate::scratch::Scratch;
use crate::simd::{Leaf, Simd, run};
use crate::winograd::Finish;
use crate::{Grid, Isa};

/// How the axes of a weight `[out, in, 3, 3]` are read.
#[derive(Clone, Copy)]
pub(crate) struct Axes {
    inputs: usize,
    outputs: usize,
    input_step: usize,
    output_step: usize,
    flipped: bool,
}

impl Axes {
    /// As the convolution reads them, or (`transposed`) its gradient by the input.
    pub(crate) fn new(outputs: usize, inputs: usize, transposed: bool) -> Self {
        match transposed {
            false => Axes { inputs, outputs, input_step: 9, output_step: 9 * inputs, flipped: false },
            true => Axes { inputs: outputs, outputs: inputs, input_step: 9 * inputs, output_step: 9, flipped: true },
        }
    }

    /// Place of the weight from `input` to `output` at `tap`.
    fn place(self, input: usize, output: usize, tap: usize) -> usize {
        let tap = if self.flipped { 8 - tap } else { tap };
        input * self.input_step + output * self.output_step + tap
    }
}

/// Most values that all taps of the outputs together may have for collecting to pay.
const MOST_COLLECTED: usize = 36;

/// Pixels of a task.
const TASK_PIXELS: usize = 96;

/// The neighbour of a pixel at a tap, if it lies in the image.
#[inline(always)]
fn neighbour(grid: Grid, row: usize, column: usize, tap: usize) -> Option<isize> {
    let (y, x) = (row + tap / 3, column + tap % 3);
    let there = y >= 1 && y <= grid.height && x >= 1 && x <= grid.width;
    there.then(|| (tap / 3) as isize * grid.width as isize + (tap % 3) as isize - grid.width as isize - 1)
}

/// Row and column of a pixel in its image.
#[inline(always)]
fn place(grid: Grid, pixel: usize) -> (usize, usize) {
    (pixel / grid.width % grid.height, pixel % grid.width)
}

/// A map, gated where the gradient comes through a ReLU.
#[derive(Clone, Copy)]
struct Source<'a> {
    map: &'a [f32],
    gate: Option<&'a [f32]>,
    channels: usize,
}

impl Source<'_> {
    fn at(&self, index: usize) -> f32 {
        match self.gate {
            Some(gate) if gate[index] <= 0.0 => 0.0,
            _ => self.map[index],
        }
    }

    /// The neighbourhoods of some pixels as rows, `step` values apart; `mirrored` for those that a pixel gives to.
    fn gather(&self, grid: Grid, pixels: std::ops::Range<usize>, mirrored: bool, rows: &mut [f32], step: usize) {
        let channels = self.channels;
        for (pixel, row) in pixels.zip(rows.chunks_mut(step)) {
            let (y, x) = place(grid, pixel);
            for tap in 0..9 {
                let to = &mut row[tap * channels..(tap + 1) * channels];
                match neighbour(grid, y, x, if mirrored { 8 - tap } else { tap }) {
                    None => to.fill(0.0),
                    Some(offset) => {
                        let first = pixel.wrapping_add_signed(offset) * channels;
                        match self.gate {
                            None => to.copy_from_slice(&self.map[first..first + channels]),
                            Some(_) => {
                                for (i, to) in to.iter_mut().enumerate() {
                                    *to = self.at(first + i);
                                }
                            }
                        }
                    }
                }
            }
        }
    }

    /// Some pixels themselves as rows, `step` values apart.
    fn copy(&self, pixels: std::ops::Range<usize>, rows: &mut [f32], step: usize) {
        let channels = self.channels;
        for (pixel, row) in pixels.zip(rows.chunks_mut(step)) {
            let first = pixel * channels;
            match self.gate {
                None => row[..channels].copy_from_slice(&self.map[first..first + channels]),
                Some(_) => {
                    for (i, to) in row[..channels].iter_mut().enumerate() {
                        *to = self.at(first + i);
                    }
                }
            }
        }
    }
}

/// One product of packed rows with packed weights.
struct Multiply<'a> {
    rows: usize,
    depth: usize,
    columns: usize,
    a: &'a [f32],
    a_step: usize,
    b: &'a [f32],
    c: &'a mut [f32],
    c_step: usize,
}

impl Leaf for Multiply<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let rows = padded_rows(self.rows);
        assert!(self.a.len() >= (rows - 1) * self.a_step + self.depth && self.c.len() >= rows * self.c_step);
        // SAFETY: just checked; the weights were packed for this depth and these columns.
        unsafe {
            let a = Left { start: self.a.as_ptr(), row_step: self.a_step, k_step: 1 };
            let b = Right::Packed(self.b.as_ptr());
            product::<S>(self.rows, self.depth, self.columns, a, b, self.c.as_mut_ptr(), self.c_step, false);
        }
    }
}

/// Packs a matrix `[depth, columns]` given by its values for [`Right::Packed`].
pub(crate) struct PackRight<'a, F> {
    pub(crate) depth: usize,
    pub(crate) columns: usize,
    pub(crate) value: F,
    pub(crate) to: &'a mut [f32],
}

impl<F: Fn(usize, usize) -> f32> Leaf for PackRight<'_, F> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let panels = Panels::new::<S>(self.columns);
        for k in 0..self.depth {
            for column in 0..panels.padded {
                let value = if column < self.columns { (self.value)(k, column) } else { 0.0 };
                self.to[panels.place(self.depth, k, column)] = value;
            }
        }
    }
}

/// Columns rounded up to what any path's vectors fill.
pub(crate) fn whole(columns: usize) -> usize {
    columns.next_multiple_of(16)
}

/// A matrix packed for [`Right::Packed`].
pub(crate) fn packed(isa: Isa, depth: usize, columns: usize, value: impl Fn(usize, usize) -> f32) -> Scratch {
    let mut to = Scratch::take(depth * whole(columns));
    // SAFETY: safe code but for its vectors' width.
    unsafe { run(isa, PackRight { depth, columns, value, to: &mut to }) };
    to
}

/// `y = finish(weight * x)`, `x` gated where a gate is given.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub(crate) fn convolve(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    gate: Option<&[f32]>,
    weight: &[f32],
    axes: Axes,
    finish: Finish,
    y: &mut [f32],
) {
    let source = Source { map: x, gate, channels: axes.inputs };
    if 9 * axes.outputs <= MOST_COLLECTED && axes.inputs > axes.outputs {
        collect(isa, grid, source, weight, axes, finish, y);
    } else {
        spread(isa, grid, source, weight, axes, finish, y);
    }
}

/// Bias and ReLU of one value.
#[inline(always)]
fn finished(finish: Finish, channel: usize, value: f32) -> f32 {
    let value = value + finish.bias.map_or(0.0, |bias| bias[channel]);
    // As the vectors' ReLU: a NaN stays.
    if finish.relu && value < 0.0 { 0.0 } else { value }
}

/// By rows of neighbourhoods.
fn spread(isa: Isa, grid: Grid, source: Source, weight: &[f32], axes: Axes, finish: Finish, y: &mut [f32]) {
    let (depth, columns) = (9 * axes.inputs, axes.outputs);
    let b = packed(isa, depth, columns, |k, column| {
        weight[axes.place(k % axes.inputs, column, k / axes.inputs)]
    });
    let wide = whole(columns);
    y.par_chunks_mut(TASK_PIXELS * columns).enumerate().for_each(|(task, y)| {
        let (first, count) = (task * TASK_PIXELS, y.len() / columns);
        let mut a = Scratch::take(padded_rows(count) * depth);
        let mut c = Scratch::take(padded_rows(count) * wide);
        source.gather(grid, first..first + count, false, &mut a, depth);
        let leaf = Multiply { rows: count, depth, columns, a: &a, a_step: depth, b: &b, c: &mut c, c_step: wide };
        // SAFETY: lengths are checked within.
        unsafe { run(isa, leaf) };
        for (y, c) in y.chunks_mut(columns).zip(c.chunks(wide)) {
            for (channel, (y, c)) in y.iter_mut().zip(c).enumerate() {
                *y = finished(finish, channel, *c);
            }
        }
    });
}

/// By the values that a pixel gives to its neighbours.
fn collect(isa: Isa, grid: Grid, source: Source, weight: &[f32], axes: Axes, finish: Finish, y: &mut [f32]) {
    let (depth, outputs) = (axes.inputs, axes.outputs);
    let columns = 9 * outputs;
    let b = packed(isa, depth, columns, |k, column| {
        weight[axes.place(k, column % outputs, column / outputs)]
    });
    let wide = whole(columns);
    let image = grid.height * grid.width;
    // An image at a time, so that what is collected is still in a cache.
    let mut given = Scratch::take((image.next_multiple_of(TASK_PIXELS) + TASK_PIXELS) * wide);
    for (index, y) in y.chunks_mut(image * outputs).enumerate() {
        given.par_chunks_mut(TASK_PIXELS * wide).enumerate().for_each(|(task, c)| {
            let first = task * TASK_PIXELS;
            if first >= image {
                return;
            }
            let count = TASK_PIXELS.min(image - first);
            let mut a = Scratch::take(padded_rows(count) * depth);
            source.copy(index * image + first..index * image + first + count, &mut a, depth);
            let leaf = Multiply { rows: count, depth, columns, a: &a, a_step: depth, b: &b, c, c_step: wide };
            // SAFETY: lengths are checked within.
            unsafe { run(isa, leaf) };
        });
        y.par_chunks_mut(grid.width * outputs).enumerate().for_each(|(row, y)| {
            for (column, y) in y.chunks_mut(outputs).enumerate() {
                let pixel = row * grid.width + column;
                let mut sums = [0.0; MOST_COLLECTED / 9];
                for tap in 0..9 {
                    if let Some(offset) = neighbour(grid, row, column, tap) {
                        let from = pixel.wrapping_add_signed(offset) * wide + tap * outputs;
                        for (sum, value) in sums.iter_mut().zip(&given[from..from + outputs]) {
                            *sum += value;
                        }
                    }
                }
                for (channel, (y, sum)) in y.iter_mut().zip(sums).enumerate() {
                    *y = finished(finish, channel, sum);
                }
            }
        });
    }
}

/// Adds a product whose reduction runs over pixels.
pub(crate) struct Accumulate<'a> {
    pub(crate) rows: usize,
    pub(crate) pixels: usize,
    pub(crate) columns: usize,
    pub(crate) a: &'a [f32],
    pub(crate) a_step: usize,
    pub(crate) b: &'a [f32],
    pub(crate) b_step: usize,
    pub(crate) c: &'a mut [f32],
    pub(crate) c_step: usize,
}

impl Leaf for Accumulate<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let rows = padded_rows(self.rows);
        assert!(self.pixels > 0 && self.a.len() >= (self.pixels - 1) * self.a_step + rows);
        assert!(self.b.len() >= (self.pixels - 1) * self.b_step + self.columns.next_multiple_of(S::LANES));
        assert!(self.c.len() >= (rows - 1) * self.c_step + self.columns.next_multiple_of(S::LANES));
        // SAFETY: just checked.
        unsafe {
            let a = Left { start: self.a.as_ptr(), row_step: 1, k_step: self.a_step };
            let b = Right::Rows { start: self.b.as_ptr(), step: self.b_step };
            product::<S>(self.rows, self.pixels, self.columns, a, b, self.c.as_mut_ptr(), self.c_step, true);
        }
    }
}

/// Stretches that the pixels are cut into for a gradient: each is summed by one task, and the sums are added in order.
const STRETCHES: usize = 16;

/// Gradient by the weight `[out, in, 3, 3]` and by the bias, `dy` gated where a gate is given.
pub(crate) fn gradient(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    dy: &[f32],
    gate: Option<&[f32]>,
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
    let (inputs, outputs) = (grid.channels(x.len()), dbias.len());
    let x = Source { map: x, gate: None, channels: inputs };
    let dy = Source { map: dy, gate, channels: outputs };
    // The thin side is the one whose neighbourhoods become rows.
    let by_output = 9 * outputs <= MOST_COLLECTED && inputs > outputs;
    let (rows, columns) = if by_output { (inputs, 9 * outputs) } else { (9 * inputs, outputs) };
    let (tall, wide) = (padded_rows(rows), whole(columns));
    let pixels = grid.pixels();
    let stretch = pixels.div_ceil(STRETCHES).next_multiple_of(TASK_PIXELS);
    let stretches = pixels.div_ceil(stretch);
    let size = tall * wide;
    let mut sums = Scratch::zeroed(stretches * size);
    let mut biases = vec![0.0f64; stretches * outputs];
    sums.par_chunks_mut(size).zip(biases.par_chunks_mut(outputs)).enumerate().for_each(|(index, (sum, bias))| {
        let end = ((index + 1) * stretch).min(pixels);
        let mut a = Scratch::zeroed(TASK_PIXELS * tall);
        let mut b = Scratch::zeroed(TASK_PIXELS * wide);
        for first in (index * stretch..end).step_by(TASK_PIXELS) {
            let range = first..(first + TASK_PIXELS).min(end);
            let count = range.len();
            for pixel in range.clone() {
                for (channel, bias) in bias.iter_mut().enumerate() {
                    *bias += f64::from(dy.at(pixel * outputs + channel));
                }
            }
            if by_output {
                x.copy(range.clone(), &mut a, tall);
                dy.gather(grid, range, true, &mut b, wide);
            } else {
                x.gather(grid, range.clone(), false, &mut a, tall);
                dy.copy(range, &mut b, wide);
            }
            let leaf = Accumulate {
                rows, pixels: count, columns, a: &a, a_step: tall, b: &b, b_step: wide, c: sum, c_step: wide,
            };
            // SAFETY: lengths are checked within.
            unsafe { run(isa, leaf) };
        }
    });
    let total = |row: usize, column: usize| -> f32 {
        (0..stretches).map(|s| sums[s * size + row * wide + column]).sum()
    };
    for o in 0..outputs {
        for i in 0..inputs {
            for tap in 0..9 {
                dweight[(o * inputs + i) * 9 + tap] = match by_output {
                    true => total(i, tap * outputs + o),
                    false => total(tap * inputs + i, o),
                };
            }
        }
        dbias[o] = biases[o..].iter().step_by(outputs).sum::<f64>() as f32;
    }
}
