//! 3x3 convolutions with few channels on one side (the first and the last of the network), as plain sums.
//!
//! Few inputs: the 3x3 neighbourhood of a pixel becomes a row of `9 * in` values (*im2col*), and the convolution one
//! product. Few outputs would leave most lanes of a vector empty; there the product makes all `9 * out` values that a
//! pixel gives to its neighbours, which are then collected (*col2im*).

use rayon::prelude::*;

use crate::product::{Left, Right, padded_rows, product};
use crate::rows::{self, BLOCK, Copy, Packed, Term, copy, whole};
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
            false => Axes {
                inputs,
                outputs,
                input_step: 9,
                output_step: 9 * inputs,
                flipped: false,
            },
            true => Axes {
                inputs: outputs,
                outputs: inputs,
                input_step: 9 * inputs,
                output_step: 9,
                flipped: true,
            },
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

/// The neighbour of a pixel at a tap, if it lies in the image.
#[inline(always)]
fn neighbour(grid: Grid, row: usize, column: usize, tap: usize) -> Option<isize> {
    let (y, x) = (row + tap / 3, column + tap % 3);
    let there = y >= 1 && y <= grid.height && x >= 1 && x <= grid.width;
    there.then(|| {
        (tap / 3) as isize * grid.width as isize + (tap % 3) as isize - grid.width as isize - 1
    })
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

/// The neighbourhoods of some pixels as rows of `9 * channels` values, `step` values apart.
struct Gather<'a> {
    source: Source<'a>,
    grid: Grid,
    pixels: std::ops::Range<usize>,
    /// Whether a row holds the pixels that this one gives to, instead of those that it takes from.
    mirrored: bool,
    rows: &'a mut [f32],
    step: usize,
}

impl Leaf for Gather<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Gather {
            source,
            grid,
            pixels,
            mirrored,
            rows,
            step,
        } = self;
        let channels = source.channels;
        assert!(
            rows.len() >= pixels.len() * step && step >= 9 * channels,
            "room for the neighbourhoods"
        );
        assert!(
            pixels.end * channels <= source.map.len(),
            "pixels of the map"
        );
        for (pixel, row) in pixels.zip(rows.chunks_exact_mut(step)) {
            let (y, x) = place(grid, pixel);
            let inside = y > 0 && y + 1 < grid.height && x > 0 && x + 1 < grid.width;
            if inside && !mirrored {
                // Three pixels side by side are three taps side by side.
                for line in 0..3 {
                    let first = (pixel + line * grid.width - grid.width - 1) * channels;
                    // SAFETY: the pixel's eight neighbours lie in the image.
                    unsafe {
                        copy_part::<S>(source, first, &mut row[line * 3 * channels..], 3 * channels)
                    };
                }
                continue;
            }
            for tap in 0..9 {
                let to = &mut row[tap * channels..(tap + 1) * channels];
                match neighbour(grid, y, x, if mirrored { 8 - tap } else { tap }) {
                    None => to.fill(0.0),
                    Some(offset) => {
                        let first = pixel.wrapping_add_signed(offset) * channels;
                        // SAFETY: the neighbour lies in the image.
                        unsafe { copy_part::<S>(source, first, to, channels) };
                    }
                }
            }
        }
    }
}

/// Copies `count` values from value `first`, gated.
///
/// # Safety
/// The machine has the path of `S`, and the map and its gate that many values there.
#[inline(always)]
unsafe fn copy_part<S: Simd>(source: Source, first: usize, to: &mut [f32], count: usize) {
    assert!(to.len() >= count);
    for at in (0..count).step_by(S::LANES) {
        let n = S::LANES.min(count - at);
        // SAFETY: `n` values from `at` on are there.
        unsafe {
            let mut v = S::load_part(source.map.as_ptr().add(first + at), n);
            if let Some(gate) = source.gate {
                v = S::gate(v, S::load_part(gate.as_ptr().add(first + at), n));
            }
            S::store_part(to.as_mut_ptr().add(at), n, v);
        }
    }
}

impl Source<'_> {
    /// See [`Gather`].
    fn gather(
        &self,
        isa: Isa,
        grid: Grid,
        pixels: std::ops::Range<usize>,
        mirrored: bool,
        rows: &mut [f32],
        step: usize,
    ) {
        assert!(
            self.gate.is_none_or(|gate| gate.len() == self.map.len()),
            "a gate of the map's size"
        );
        let leaf = Gather {
            source: *self,
            grid,
            pixels,
            mirrored,
            rows,
            step,
        };
        // SAFETY: the leaf checks its lengths, the gate's was checked.
        unsafe { run(isa, leaf) }
    }

    /// Some pixels themselves as rows, `step` values apart.
    fn copy(&self, isa: Isa, pixels: std::ops::Range<usize>, rows: &mut [f32], step: usize) {
        let (first, channels) = (pixels.start * self.channels, self.channels);
        copy(
            isa,
            Copy {
                from: &self.map[first..],
                from_step: channels,
                gate: self.gate.map(|gate| &gate[first..]),
                bias: None,
                relu: false,
                to: rows,
                to_step: step,
                rows: pixels.len(),
                channels,
            },
        );
    }
}

/// `y = finish(weight * x)`, `x` gated where a gate is given, of the rows from `above` on, as many as `y` has; `grid` is
/// that of `x`.
///
/// # Panics
/// Where there are several images and `y` does not have all their rows.
#[allow(clippy::too_many_arguments, reason = "what a convolution is made of")]
pub(crate) fn convolve(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    gate: Option<&[f32]>,
    above: usize,
    weight: &[f32],
    axes: Axes,
    finish: Finish,
    y: &mut [f32],
) {
    let source = Source {
        map: x,
        gate,
        channels: axes.inputs,
    };
    let height = y.len() / (grid.batch * grid.width * axes.outputs);
    assert!(
        above + height <= grid.height,
        "rows {above} to {} of {grid:?}",
        above + height
    );
    assert!(
        grid.batch == 1 || height == grid.height,
        "a band of a single image"
    );
    if 9 * axes.outputs <= MOST_COLLECTED && axes.inputs > axes.outputs {
        collect(isa, grid, source, above, weight, axes, finish, y);
    } else {
        spread(isa, grid, source, above, weight, axes, finish, y);
    }
}

/// By rows of neighbourhoods.
#[allow(clippy::too_many_arguments, reason = "as `convolve`")]
fn spread(
    isa: Isa,
    grid: Grid,
    source: Source,
    above: usize,
    weight: &[f32],
    axes: Axes,
    finish: Finish,
    y: &mut [f32],
) {
    let (depth, columns) = (9 * axes.inputs, axes.outputs);
    let b = Packed::new(isa, depth, columns, |k, column| {
        weight[axes.place(k % axes.inputs, column, k / axes.inputs)]
    });
    let wide = whole(columns);
    y.par_chunks_mut(BLOCK * columns)
        .enumerate()
        .for_each(|(task, y)| {
            let (first, count) = (task * BLOCK, y.len() / columns);
            let mut a = Scratch::take(padded_rows(count) * depth);
            let mut c = Scratch::take(padded_rows(count) * wide);
            let skipped = above * grid.width;
            source.gather(
                isa,
                grid,
                skipped + first..skipped + first + count,
                false,
                &mut a,
                depth,
            );
            rows::sum(
                isa,
                count,
                &[Term {
                    rows: &a,
                    step: depth,
                    weight: &b,
                }],
                &mut c,
                wide,
            );
            copy(
                isa,
                Copy {
                    from: &c,
                    from_step: wide,
                    gate: None,
                    bias: finish.bias,
                    relu: finish.relu,
                    to: y,
                    to_step: columns,
                    rows: count,
                    channels: columns,
                },
            );
        });
}

/// By the values that a pixel gives to its neighbours.
#[allow(clippy::too_many_arguments, reason = "as `convolve`")]
fn collect(
    isa: Isa,
    grid: Grid,
    source: Source,
    above: usize,
    weight: &[f32],
    axes: Axes,
    finish: Finish,
    y: &mut [f32],
) {
    let (depth, outputs) = (axes.inputs, axes.outputs);
    let columns = 9 * outputs;
    let b = Packed::new(isa, depth, columns, |k, column| {
        weight[axes.place(k, column % outputs, column / outputs)]
    });
    let wide = whole(columns);
    let image = grid.height * grid.width;
    // An image at a time, so that what is collected is still in a cache.
    let mut given = Scratch::take((image.next_multiple_of(BLOCK) + BLOCK) * wide);
    let rows = y.len() / grid.batch;
    for (index, y) in y.chunks_mut(rows).enumerate() {
        given
            .par_chunks_mut(BLOCK * wide)
            .take(image.div_ceil(BLOCK))
            .enumerate()
            .for_each(|(task, c)| {
                let first = task * BLOCK;
                let count = BLOCK.min(image - first);
                let mut a = Scratch::take(padded_rows(count) * depth);
                source.copy(
                    isa,
                    index * image + first..index * image + first + count,
                    &mut a,
                    depth,
                );
                rows::sum(
                    isa,
                    count,
                    &[Term {
                        rows: &a,
                        step: depth,
                        weight: &b,
                    }],
                    c,
                    wide,
                );
            });
        y.par_chunks_mut(grid.width * outputs)
            .enumerate()
            .for_each(|(row, y)| {
                let leaf = Collect {
                    grid,
                    given: &given,
                    wide,
                    finish,
                    row: above + row,
                    outputs,
                    y,
                };
                // SAFETY: the leaf checks its lengths.
                unsafe { run(isa, leaf) }
            });
    }
}

/// Sums what the neighbours of a row of pixels give to it.
struct Collect<'a> {
    grid: Grid,
    given: &'a [f32],
    wide: usize,
    finish: Finish<'a>,
    row: usize,
    outputs: usize,
    y: &'a mut [f32],
}

impl Leaf for Collect<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Collect {
            grid,
            given,
            wide,
            finish,
            row,
            outputs,
            y,
        } = self;
        assert!(y.len() == grid.width * outputs && row < grid.height);
        assert!(given.len() >= grid.height * grid.width * wide && wide >= 9 * outputs);
        for (column, y) in y.chunks_exact_mut(outputs).enumerate() {
            let pixel = row * grid.width + column;
            for channel in (0..outputs).step_by(S::LANES) {
                let n = S::LANES.min(outputs - channel);
                // SAFETY: neighbours are pixels of the image, each with `9 * outputs` values.
                unsafe {
                    let mut sum = finish.bias::<S>(channel, n);
                    for tap in 0..9 {
                        if let Some(offset) = neighbour(grid, row, column, tap) {
                            let from =
                                pixel.wrapping_add_signed(offset) * wide + tap * outputs + channel;
                            sum = S::add(sum, S::load_part(given.as_ptr().add(from), n));
                        }
                    }
                    let value = if finish.relu { S::relu(sum) } else { sum };
                    S::store_part(y.as_mut_ptr().add(channel), n, value);
                }
            }
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
    let x = Source {
        map: x,
        gate: None,
        channels: inputs,
    };
    let dy = Source {
        map: dy,
        gate,
        channels: outputs,
    };
    // The thin side is the one whose neighbourhoods become rows.
    let by_output = 9 * outputs <= MOST_COLLECTED && inputs > outputs;
    let (rows, columns) = if by_output {
        (inputs, 9 * outputs)
    } else {
        (9 * inputs, outputs)
    };
    // One row more, of ones: its gradient is the sum of `dy`, the bias's.
    let (tall, wide) = (padded_rows(rows + 1), whole(columns));
    let pixels = grid.pixels();
    let stretch = pixels.div_ceil(STRETCHES).next_multiple_of(BLOCK);
    let stretches = pixels.div_ceil(stretch);
    let size = tall * wide;
    let mut sums = Scratch::zeroed(stretches * size);
    sums.par_chunks_mut(size)
        .enumerate()
        .for_each(|(index, sum)| {
            let end = ((index + 1) * stretch).min(pixels);
            let mut a = Scratch::zeroed(BLOCK * tall);
            a.iter_mut()
                .skip(rows)
                .step_by(tall)
                .for_each(|one| *one = 1.0);
            let mut b = Scratch::zeroed(BLOCK * wide);
            for first in (index * stretch..end).step_by(BLOCK) {
                let range = first..(first + BLOCK).min(end);
                let count = range.len();
                if by_output {
                    x.copy(isa, range.clone(), &mut a, tall);
                    dy.gather(isa, grid, range, true, &mut b, wide);
                } else {
                    x.gather(isa, grid, range.clone(), false, &mut a, tall);
                    dy.copy(isa, range, &mut b, wide);
                }
                let leaf = Accumulate {
                    rows: rows + 1,
                    pixels: count,
                    columns,
                    a: &a,
                    a_step: tall,
                    b: &b,
                    b_step: wide,
                    c: sum,
                    c_step: wide,
                };
                // SAFETY: lengths are checked within.
                unsafe { run(isa, leaf) };
            }
        });
    let total = |row: usize, column: usize| -> f32 {
        (0..stretches)
            .map(|s| sums[s * size + row * wide + column])
            .sum()
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
        // Among the neighbourhoods of `dy` the middle tap is `dy` itself.
        dbias[o] = total(rows, if by_output { 4 * outputs + o } else { o });
    }
}

/// Adds a product whose reduction runs over pixels.
struct Accumulate<'a> {
    rows: usize,
    pixels: usize,
    columns: usize,
    a: &'a [f32],
    a_step: usize,
    b: &'a [f32],
    b_step: usize,
    c: &'a mut [f32],
    c_step: usize,
}

impl Leaf for Accumulate<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let rows = padded_rows(self.rows);
        assert!(self.pixels > 0 && self.a.len() >= (self.pixels - 1) * self.a_step + rows);
        assert!(
            self.b.len()
                >= (self.pixels - 1) * self.b_step + self.columns.next_multiple_of(S::LANES)
        );
        assert!(self.c.len() >= (rows - 1) * self.c_step + self.columns.next_multiple_of(S::LANES));
        // SAFETY: just checked.
        unsafe {
            let a = Left {
                start: self.a.as_ptr(),
                row_step: 1,
                k_step: self.a_step,
            };
            let b = Right::Rows {
                start: self.b.as_ptr(),
                step: self.b_step,
            };
            product::<S>(
                self.rows,
                self.pixels,
                self.columns,
                a,
                b,
                self.c.as_mut_ptr(),
                self.c_step,
                true,
            );
        }
    }
}
