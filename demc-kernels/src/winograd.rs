//! 3x3 convolutions with fewer multiplications (Winograd 1980; Lavin and Gray 2016).
//!
//! An output tile of `OUT x OUT` pixels needs an input tile of `IN x IN`, `IN = OUT + 2`. Both are taken to a space of
//! `IN x IN` *places* in which the convolution is one product of matrices a place, `tiles x in` times `in x out`:
//! `Y = A^T [ (G w G^T) * (B^T x B) ] A`. F(2x2, 3x3) multiplies 2.25 times less than the plain sum and is as exact;
//! F(4x4, 3x3) 4 times less, and loses about a digit.
//!
//! With channels last all three transforms work on vectors of channels and shuffle nothing.

use rayon::prelude::*;

use crate::product::{Left, Panels, Right, padded_rows, product};
use crate::scratch::{Scratch, Shared};
use crate::simd::{Leaf, Simd, run};
use crate::{Grid, Isa};

/// One-dimensional transforms of the two tile sizes, by their input length.
mod line {
    use crate::simd::Simd;

    /// `B^T d`.
    ///
    /// # Safety
    /// The machine has the path of `S`; so for all here.
    #[inline(always)]
    pub(super) unsafe fn input<S: Simd, const IN: usize>(d: [S::V; IN]) -> [S::V; IN] {
        // SAFETY: the caller's.
        unsafe {
            let mut t = d;
            if IN == 4 {
                t[0] = S::sub(d[0], d[2]);
                t[1] = S::add(d[1], d[2]);
                t[2] = S::sub(d[2], d[1]);
                t[3] = S::sub(d[1], d[3]);
            } else {
                let (two, four, five) = (S::splat(2.0), S::splat(4.0), S::splat(-5.0));
                let even = S::fma(four, S::sub(S::zero(), d[2]), d[4]);
                let odd = S::fma(four, S::sub(S::zero(), d[1]), d[3]);
                let (near, far) = (S::sub(d[4], d[2]), S::mul(two, S::sub(d[3], d[1])));
                t[0] = S::fma(four, d[0], S::fma(five, d[2], d[4]));
                t[1] = S::add(even, odd);
                t[2] = S::sub(even, odd);
                t[3] = S::add(near, far);
                t[4] = S::sub(near, far);
                t[5] = S::fma(four, d[1], S::fma(five, d[3], d[5]));
            }
            t
        }
    }

    /// `A^T m`, of which the first `IN - 2` count.
    #[inline(always)]
    pub(super) unsafe fn output<S: Simd, const IN: usize>(m: [S::V; IN]) -> [S::V; IN] {
        // SAFETY: the caller's.
        unsafe {
            let mut y = m;
            if IN == 4 {
                y[0] = S::add(S::add(m[0], m[1]), m[2]);
                y[1] = S::sub(S::sub(m[1], m[2]), m[3]);
            } else {
                let (two, four, eight) = (S::splat(2.0), S::splat(4.0), S::splat(8.0));
                let (s1, d1) = (S::add(m[1], m[2]), S::sub(m[1], m[2]));
                let (s2, d2) = (S::add(m[3], m[4]), S::sub(m[3], m[4]));
                y[0] = S::add(S::add(m[0], s1), s2);
                y[1] = S::fma(two, d2, d1);
                y[2] = S::fma(four, s2, s1);
                y[3] = S::add(S::fma(eight, d2, d1), m[5]);
            }
            y
        }
    }

    /// `A y`: the transposed of [`output`], of the first `IN - 2`.
    #[inline(always)]
    pub(super) unsafe fn output_transposed<S: Simd, const IN: usize>(y: [S::V; IN]) -> [S::V; IN] {
        // SAFETY: the caller's.
        unsafe {
            let mut m = y;
            if IN == 4 {
                m[0] = y[0];
                m[1] = S::add(y[0], y[1]);
                m[2] = S::sub(y[0], y[1]);
                m[3] = S::sub(S::zero(), y[1]);
            } else {
                let (two, four, eight) = (S::splat(2.0), S::splat(4.0), S::splat(8.0));
                let (even, odd) = (S::add(y[0], y[2]), S::add(y[1], y[3]));
                let (even2, odd2) = (
                    S::fma(four, y[2], y[0]),
                    S::fma(eight, y[3], S::mul(two, y[1])),
                );
                m[0] = y[0];
                m[1] = S::add(even, odd);
                m[2] = S::sub(even, odd);
                m[3] = S::add(even2, odd2);
                m[4] = S::sub(even2, odd2);
                m[5] = y[3];
            }
            m
        }
    }

    /// `G w`, of the first 3.
    #[inline(always)]
    pub(super) unsafe fn weight<S: Simd, const IN: usize>(w: [S::V; IN]) -> [S::V; IN] {
        // SAFETY: the caller's.
        unsafe {
            let mut u = w;
            if IN == 4 {
                let half = S::splat(0.5);
                let (sum, mid) = (S::mul(half, S::add(w[0], w[2])), S::mul(half, w[1]));
                u[0] = w[0];
                u[1] = S::add(sum, mid);
                u[2] = S::sub(sum, mid);
                u[3] = w[2];
            } else {
                let (sixth, twelfth) = (S::splat(-1.0 / 6.0), S::splat(1.0 / 12.0));
                let (sum, mid) = (S::mul(sixth, S::add(w[0], w[2])), S::mul(sixth, w[1]));
                let far = S::fma(
                    S::splat(1.0 / 24.0),
                    w[0],
                    S::mul(S::splat(1.0 / 6.0), w[2]),
                );
                let mid2 = S::mul(twelfth, w[1]);
                u[0] = S::mul(S::splat(0.25), w[0]);
                u[1] = S::add(sum, mid);
                u[2] = S::sub(sum, mid);
                u[3] = S::add(far, mid2);
                u[4] = S::sub(far, mid2);
                u[5] = w[2];
            }
            u
        }
    }

    /// `G^T u`, of which the first 3 count.
    #[inline(always)]
    pub(super) unsafe fn weight_transposed<S: Simd, const IN: usize>(u: [S::V; IN]) -> [S::V; IN] {
        // SAFETY: the caller's.
        unsafe {
            let mut w = u;
            let (s1, d1) = (S::add(u[1], u[2]), S::sub(u[1], u[2]));
            if IN == 4 {
                let half = S::splat(0.5);
                w[0] = S::fma(half, s1, u[0]);
                w[1] = S::mul(half, d1);
                w[2] = S::fma(half, s1, u[3]);
            } else {
                let (sixth, twelfth) = (S::splat(1.0 / 6.0), S::splat(1.0 / 12.0));
                let (s2, d2) = (S::add(u[3], u[4]), S::sub(u[3], u[4]));
                let near = S::mul(sixth, s1);
                w[0] = S::sub(
                    S::fma(S::splat(0.25), u[0], S::mul(S::splat(1.0 / 24.0), s2)),
                    near,
                );
                w[1] = S::sub(S::mul(twelfth, d2), S::mul(sixth, d1));
                w[2] = S::add(S::sub(S::mul(sixth, s2), near), u[5]);
            }
            w
        }
    }
}

/// The body once for each `$i` below `$n` (at most 6), with `$i` known to the compiler: an array that is indexed in a
/// loop that stays a loop lives in memory and not in registers.
macro_rules! each {
    ($i:ident < $n:expr, $body:block) => {{
        each!(@ $i, $n, $body, 0 1 2 3 4 5);
    }};
    (@ $i:ident, $n:expr, $body:block, $($value:literal)*) => {
        $(
            if $value < $n {
                let $i: usize = $value;
                $body
            }
        )*
    };
}

/// A transform in both dimensions: over all columns, then over all rows.
macro_rules! both {
    ($f:path, $s:ty, $n:expr, $d:expr) => {{
        let mut values = $d;
        each!(c < $n, {
            let mut column: [<$s>::V; $n] = [values[0][c]; $n];
            each!(r < $n, {
                column[r] = values[r][c];
            });
            let column = $f(column);
            each!(r < $n, {
                values[r][c] = column[r];
            });
        });
        each!(r < $n, {
            values[r] = $f(values[r]);
        });
        values
    }};
}

/// The tiles that cover a grid.
#[derive(Clone, Copy)]
struct Tiles {
    /// Of the output.
    grid: Grid,
    /// Of the input: more rows where the output is a band of an image.
    input: Grid,
    /// Rows of the input above the output's first.
    above: usize,
    out: usize,
    down: usize,
    across: usize,
}

impl Tiles {
    fn new(grid: Grid, out: usize) -> Self {
        Tiles::of_rows(grid, 0, grid.height, out)
    }

    /// Those of `height` rows from `above` on.
    fn of_rows(input: Grid, above: usize, height: usize, out: usize) -> Self {
        let grid = Grid { height, ..input };
        let (down, across) = (height.div_ceil(out), grid.width.div_ceil(out));
        Tiles {
            grid,
            input,
            above,
            out,
            down,
            across,
        }
    }

    fn count(self) -> usize {
        self.grid.batch * self.down * self.across
    }

    /// First pixel of the image, row and column of a tile's output.
    fn at(self, tile: usize) -> (usize, usize, usize) {
        let (image, rest) = (
            tile / (self.down * self.across),
            tile % (self.down * self.across),
        );
        let first = image * self.grid.height * self.grid.width;
        (
            first,
            rest / self.across * self.out,
            rest % self.across * self.out,
        )
    }

    /// First pixel of the input's image, row and column there of a tile's input, which begins a row and a column before
    /// its output.
    fn input_at(self, tile: usize) -> (usize, isize, isize) {
        let (_, row, column) = self.at(tile);
        let first = tile / (self.down * self.across) * self.input.height * self.input.width;
        (first, (row + self.above) as isize - 1, column as isize - 1)
    }
}

/// Weights in the space of the products.
pub(crate) struct Weights {
    isa: Isa,
    depth: usize,
    columns: usize,
    place_step: usize,
    values: Scratch,
}

/// How the axes of a weight `[out, in, 3, 3]` are read.
#[derive(Clone, Copy)]
struct Axes {
    depth: usize,
    columns: usize,
    depth_step: usize,
    column_step: usize,
    flipped: bool,
}

impl Axes {
    /// As the convolution reads them, or its gradient by the input.
    fn new(outputs: usize, inputs: usize, transposed: bool) -> Self {
        match transposed {
            false => Axes {
                depth: inputs,
                columns: outputs,
                depth_step: 9,
                column_step: 9 * inputs,
                flipped: false,
            },
            true => Axes {
                depth: outputs,
                columns: inputs,
                depth_step: 9 * inputs,
                column_step: 9,
                flipped: true,
            },
        }
    }

    fn place(self, k: usize, column: usize, tap: usize) -> usize {
        let tap = if self.flipped { 8 - tap } else { tap };
        k * self.depth_step + column * self.column_step + tap
    }
}

/// Takes some rows of the weights to the space of the products.
struct Pack<'a, const IN: usize> {
    weight: &'a [f32],
    axes: Axes,
    rows: std::ops::Range<usize>,
    to: Shared,
    place_step: usize,
}

impl<const IN: usize> Leaf for Pack<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        const WIDEST: usize = 16;
        let panels = Panels::new::<S>(self.axes.columns);
        for k in self.rows {
            for first in (0..panels.padded).step_by(S::LANES) {
                let mut taps = [[0.0; WIDEST]; 9];
                for lane in 0..S::LANES.min(self.axes.columns - first) {
                    for (tap, lanes) in taps.iter_mut().enumerate() {
                        lanes[lane] = self.weight[self.axes.place(k, first + lane, tap)];
                    }
                }
                // SAFETY: `taps` holds a vector a tap; `to` holds IN * IN places of a whole vector here, which belong to
                // this row alone.
                unsafe {
                    let mut w = [[S::zero(); IN]; IN];
                    for (tap, lanes) in taps.iter().enumerate() {
                        w[tap / 3][tap % 3] = S::load(lanes.as_ptr());
                    }
                    let u = both!(line::weight::<S, IN>, S, IN, w);
                    let to = self
                        .to
                        .pointer()
                        .add(panels.place(self.axes.depth, k, first));
                    for place in 0..IN * IN {
                        S::store(to.add(place * self.place_step), u[place / IN][place % IN]);
                    }
                }
            }
        }
    }
}

/// Columns rounded up to whole vectors of `isa`.
struct Padded(usize);

impl Leaf for Padded {
    type Out = usize;

    #[inline(always)]
    unsafe fn run<S: Simd>(self) -> usize {
        self.0.next_multiple_of(S::LANES)
    }
}

fn padded(isa: Isa, columns: usize) -> usize {
    // SAFETY: arithmetic only.
    unsafe { run(isa, Padded(columns)) }
}

/// Distance between places: an odd number of cache lines, so that the places of a tile fall into different sets.
fn place_step(values: usize) -> usize {
    values.next_multiple_of(16) + 16
}

impl Weights {
    /// Of a weight `[out, in, 3, 3]`; `transposed` for the gradient by the input.
    pub(crate) fn new<const IN: usize>(
        isa: Isa,
        weight: &[f32],
        outputs: usize,
        inputs: usize,
        transposed: bool,
    ) -> Self {
        let axes = Axes::new(outputs, inputs, transposed);
        let place_step = place_step(axes.depth * padded(isa, axes.columns));
        let mut values = Scratch::take(IN * IN * place_step);
        let to = Shared::new(&mut values);
        let step = (8192 / axes.columns).max(1);
        (0..axes.depth.div_ceil(step))
            .into_par_iter()
            .for_each(|task| {
                let rows = task * step..((task + 1) * step).min(axes.depth);
                let leaf = Pack::<IN> {
                    weight,
                    axes,
                    rows,
                    to,
                    place_step,
                };
                // SAFETY: tasks write different rows, all of them within `values`.
                unsafe { run(isa, leaf) }
            });
        Weights {
            isa,
            depth: axes.depth,
            columns: axes.columns,
            place_step,
            values,
        }
    }
}

/// A map to read, gated by another one where the gradient comes through a ReLU.
#[derive(Clone, Copy)]
struct Source<'a> {
    map: &'a [f32],
    gate: Option<&'a [f32]>,
    channels: usize,
}

impl Source<'_> {
    /// The `size x size` pixels of a tile from `(row, column)` of the image at `image`, zeros where there is none.
    ///
    /// # Safety
    /// The machine has the path of `S`.
    #[inline(always)]
    unsafe fn tile<S: Simd, const IN: usize, const SIZE: usize>(
        &self,
        grid: Grid,
        image: usize,
        row: isize,
        column: isize,
        channel: usize,
    ) -> [[S::V; IN]; IN] {
        let n = S::LANES.min(self.channels - channel);
        let inside = row >= 0
            && column >= 0
            && row as usize + SIZE <= grid.height
            && column as usize + SIZE <= grid.width;
        // SAFETY: only pixels of the image are loaded, `n` channels of which are there.
        unsafe {
            let mut d = [[S::zero(); IN]; IN];
            if inside && n == S::LANES {
                let first =
                    (image + row as usize * grid.width + column as usize) * self.channels + channel;
                let line = grid.width * self.channels;
                let map = self.map.as_ptr().add(first);
                match self.gate {
                    None => each!(r < SIZE, {
                        let map = map.add(r * line);
                        each!(c < SIZE, {
                            d[r][c] = S::load(map.add(c * self.channels));
                        });
                    }),
                    Some(gate) => {
                        let gate = gate.as_ptr().add(first);
                        each!(r < SIZE, {
                            let (map, gate) = (map.add(r * line), gate.add(r * line));
                            each!(c < SIZE, {
                                let at = c * self.channels;
                                d[r][c] = S::gate(S::load(map.add(at)), S::load(gate.add(at)));
                            });
                        });
                    }
                }
            } else {
                #[allow(clippy::needless_range_loop, reason = "two arrays' worth of indices")]
                for r in 0..SIZE {
                    for c in 0..SIZE {
                        let (y, x) = (row + r as isize, column + c as isize);
                        let there = y >= 0
                            && x >= 0
                            && (y as usize) < grid.height
                            && (x as usize) < grid.width;
                        if there {
                            let pixel = image + y as usize * grid.width + x as usize;
                            let at = pixel * self.channels + channel;
                            let value = S::load_part(self.map.as_ptr().add(at), n);
                            d[r][c] = match self.gate {
                                None => value,
                                Some(gate) => {
                                    S::gate(value, S::load_part(gate.as_ptr().add(at), n))
                                }
                            };
                        }
                    }
                }
            }
            d
        }
    }
}

/// Tiles of a map in the space of the products: `[place][tile][channel]`.
#[derive(Clone, Copy)]
struct Space {
    start: *mut f32,
    place_step: usize,
    tile_step: usize,
}

impl Space {
    /// Puts a vector of channels of a tile to its places.
    ///
    /// # Safety
    /// The machine has the path of `S`, and the tile is the caller's to write.
    #[inline(always)]
    unsafe fn store<S: Simd, const IN: usize>(
        self,
        tile: usize,
        channel: usize,
        v: [[S::V; IN]; IN],
    ) {
        // SAFETY: the caller's.
        unsafe {
            let to = self.start.add(tile * self.tile_step + channel);
            each!(r < IN, {
                let to = to.add(r * IN * self.place_step);
                each!(c < IN, {
                    S::store(to.add(c * self.place_step), v[r][c]);
                });
            });
        }
    }

    /// Gets them.
    ///
    /// # Safety
    /// As for `store`, to read.
    #[inline(always)]
    unsafe fn load<S: Simd, const IN: usize>(
        self,
        tile: usize,
        channel: usize,
    ) -> [[S::V; IN]; IN] {
        // SAFETY: the caller's.
        unsafe {
            let from = self.start.add(tile * self.tile_step + channel);
            let mut v = [[S::zero(); IN]; IN];
            each!(r < IN, {
                let from = from.add(r * IN * self.place_step);
                each!(c < IN, {
                    v[r][c] = S::load(from.add(c * self.place_step));
                });
            });
            v
        }
    }
}

/// `B^T x B` of some tiles.
///
/// # Safety
/// The machine has the path of `S`, and the tiles from `to` on are the caller's to write.
#[inline(always)]
unsafe fn take_input<S: Simd, const IN: usize>(
    source: Source,
    tiles: Tiles,
    range: std::ops::Range<usize>,
    to: Space,
) {
    for (index, tile) in range.enumerate() {
        let (image, row, column) = tiles.input_at(tile);
        for channel in (0..source.channels).step_by(S::LANES) {
            // SAFETY: the caller's.
            unsafe {
                let d = source.tile::<S, IN, IN>(tiles.input, image, row, column, channel);
                let v = both!(line::input::<S, IN>, S, IN, d);
                to.store::<S, IN>(index, channel, v);
            }
        }
    }
}

/// What happens to the result of a convolution: bias, ReLU.
#[derive(Clone, Copy)]
pub(crate) struct Finish<'a> {
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) relu: bool,
}

impl Finish<'_> {
    /// The bias of `n` channels from `channel`.
    #[inline(always)]
    pub(crate) unsafe fn bias<S: Simd>(&self, channel: usize, n: usize) -> S::V {
        // SAFETY: `n` values are there; the caller has the path of `S`.
        unsafe {
            match self.bias {
                Some(bias) => S::load_part(bias[channel..channel + n].as_ptr(), n),
                None => S::zero(),
            }
        }
    }
}

/// Input transform, products, output transform of some tiles and some panels of columns.
struct Block<'a, const IN: usize> {
    source: Source<'a>,
    weights: &'a Weights,
    finish: Finish<'a>,
    tiles: Tiles,
    range: std::ops::Range<usize>,
    y: Shared,
}

impl<const IN: usize> Leaf for Block<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Block {
            source,
            weights,
            finish,
            tiles,
            range,
            y,
        } = self;
        let (depth, columns, out) = (weights.depth, weights.columns, IN - 2);
        let (count, rows) = (range.len(), padded_rows(range.len()));
        let space = |scratch: &mut Scratch, channels: usize| Space {
            start: scratch.as_mut_ptr(),
            place_step: place_step(rows * channels),
            tile_step: channels,
        };
        let (wide, tall) = (
            columns.next_multiple_of(S::LANES),
            depth.next_multiple_of(S::LANES),
        );
        let mut input = Scratch::take(IN * IN * place_step(rows * tall));
        let mut output = Scratch::take(IN * IN * place_step(rows * wide));
        let (v, m) = (space(&mut input, tall), space(&mut output, wide));
        // SAFETY: the scratch buffers hold `rows` tiles a place; the tiles of `range` are this leaf's to write in `y`.
        unsafe {
            take_input::<S, IN>(source, tiles, range.clone(), v);
            for place in 0..IN * IN {
                let a = Left {
                    start: v.start.add(place * v.place_step),
                    row_step: tall,
                    k_step: 1,
                };
                let b = Right::Packed(weights.values.as_ptr().add(place * weights.place_step));
                let c = m.start.add(place * m.place_step);
                product::<S>(count, depth, columns, a, b, c, wide, false);
            }
            for (index, tile) in range.enumerate() {
                let (image, row, column) = tiles.at(tile);
                let whole = row + out <= tiles.grid.height && column + out <= tiles.grid.width;
                let line = tiles.grid.width * columns;
                let to = y
                    .pointer()
                    .add((image + row * tiles.grid.width + column) * columns);
                for channel in (0..columns).step_by(S::LANES) {
                    let n = S::LANES.min(columns - channel);
                    let bias = finish.bias::<S>(channel, n);
                    let mut result = both!(
                        line::output::<S, IN>,
                        S,
                        IN,
                        m.load::<S, IN>(index, channel)
                    );
                    each!(r < out, {
                        each!(c < out, {
                            let value = S::add(result[r][c], bias);
                            result[r][c] = if finish.relu { S::relu(value) } else { value };
                        });
                    });
                    let to = to.add(channel);
                    if whole && n == S::LANES {
                        each!(r < out, {
                            each!(c < out, {
                                S::store(to.add(r * line + c * columns), result[r][c]);
                            });
                        });
                    } else {
                        for (r, result) in result[..out.min(tiles.grid.height - row)]
                            .iter()
                            .enumerate()
                        {
                            for (c, value) in result[..out.min(tiles.grid.width - column)]
                                .iter()
                                .enumerate()
                            {
                                S::store_part(to.add(r * line + c * columns), n, *value);
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Values of a block's two buffers that the second-level cache of today's cores holds beside the weights of a place.
const BLOCK_VALUES: usize = 128 << 10;

/// Most tiles of a block.
const MOST_TILES: usize = 192;

/// Fewest tiles of a block, below which loading the weights takes longer than using them.
const FEWEST_TILES: usize = 48;

/// Tiles of a block, for as many blocks as keeps all threads at work.
fn block_tiles(tiles: usize, values_per_tile: usize, weights: usize) -> usize {
    // Where the weights fall out of the second-level cache, more tiles use them while they are there.
    let fewest = if weights > 4 * BLOCK_VALUES {
        MOST_TILES / 2
    } else {
        FEWEST_TILES
    };
    let most = (BLOCK_VALUES / values_per_tile).clamp(fewest, MOST_TILES);
    let threads = rayon::current_num_threads();
    let blocks = tiles.div_ceil(most).next_multiple_of(threads);
    tiles.div_ceil(blocks)
}

/// `y = finish(w * x)`, `x` gated where a gate is given.
///
/// # Panics
/// Where a length is not that of its map.
pub(crate) fn convolve<const IN: usize>(
    grid: Grid,
    x: &[f32],
    gate: Option<&[f32]>,
    weights: &Weights,
    finish: Finish,
    y: &mut [f32],
) {
    convolve_rows::<IN>(grid, x, gate, 0, weights, finish, y);
}

/// The same of the rows from `above` on, as many as `y` has; `grid` is that of `x`.
///
/// # Panics
/// Where a length is not that of its map, or `x` does not have those rows.
pub(crate) fn convolve_rows<const IN: usize>(
    grid: Grid,
    x: &[f32],
    gate: Option<&[f32]>,
    above: usize,
    weights: &Weights,
    finish: Finish,
    y: &mut [f32],
) {
    let (depth, columns) = (weights.depth, weights.columns);
    let height = y.len() / (grid.batch * grid.width * columns);
    assert_eq!(
        x.len(),
        grid.pixels() * depth,
        "a map of {depth} channels on {grid:?}"
    );
    assert_eq!(
        y.len(),
        grid.batch * height * grid.width * columns,
        "a map of {columns} channels on {grid:?}"
    );
    assert!(
        above + height <= grid.height,
        "rows {above} to {} of {grid:?}",
        above + height
    );
    assert!(
        gate.is_none_or(|gate| gate.len() == x.len()),
        "the gate of a map of {} values",
        x.len()
    );
    let source = Source {
        map: x,
        gate,
        channels: depth,
    };
    let tiles = Tiles::of_rows(grid, above, height, IN - 2);
    let step = block_tiles(
        tiles.count(),
        IN * IN * (depth + columns),
        weights.values.len(),
    );
    let y = Shared::new(y);
    (0..tiles.count().div_ceil(step))
        .into_par_iter()
        .for_each(|task| {
            let range = task * step..((task + 1) * step).min(tiles.count());
            let leaf = Block::<IN> {
                source,
                weights,
                finish,
                tiles,
                range,
                y,
            };
            // SAFETY: every tile of `y` is written by one task; `source` and the weights have the lengths checked above.
            unsafe { run(weights.isa, leaf) }
        });
}

/// Transforms of some tiles for the weights' gradient: `B^T x B` and `A dy A^T`, and the sum of `dy`.
struct Taken<'a, const IN: usize> {
    x: Source<'a>,
    dy: Source<'a>,
    tiles: Tiles,
    range: std::ops::Range<usize>,
    /// Index of the first tile within the buffers.
    index: usize,
    v: (Shared, usize, usize),
    z: (Shared, usize, usize),
    /// Sum of `dy` over the tiles, whole vectors.
    dbias: Shared,
}

impl<const IN: usize> Leaf for Taken<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let space = |(start, place_step, tile_step): (Shared, usize, usize)| Space {
            // The tiles from `index` on.
            start: start.pointer().wrapping_add(self.index * tile_step),
            place_step,
            tile_step,
        };
        let (v, z) = (space(self.v), space(self.z));
        // SAFETY: tiles from `index` on are this leaf's; `dbias` holds whole vectors, this leaf's too.
        unsafe {
            take_input::<S, IN>(self.x, self.tiles, self.range.clone(), v);
            for channel in (0..self.dy.channels).step_by(S::LANES) {
                S::store(self.dbias.pointer().add(channel), S::zero());
            }
            for (index, tile) in self.range.enumerate() {
                let (image, row, column) = self.tiles.at(tile);
                let (row, column) = (row as isize, column as isize);
                for channel in (0..self.dy.channels).step_by(S::LANES) {
                    let d = match IN {
                        4 => self
                            .dy
                            .tile::<S, IN, 2>(self.tiles.grid, image, row, column, channel),
                        _ => self
                            .dy
                            .tile::<S, IN, 4>(self.tiles.grid, image, row, column, channel),
                    };
                    let to = self.dbias.pointer().add(channel);
                    let mut sum = S::load(to);
                    each!(r < IN - 2, {
                        each!(c < IN - 2, {
                            sum = S::add(sum, d[r][c]);
                        });
                    });
                    S::store(to, sum);
                    let m = both!(line::output_transposed::<S, IN>, S, IN, d);
                    z.store::<S, IN>(index, channel, m);
                }
            }
        }
    }
}

/// Adds the products of a chunk of tiles to some rows of a place of the gradient.
struct Accumulate {
    rows: usize,
    depth: usize,
    columns: usize,
    a: Shared,
    a_step: usize,
    b: Shared,
    b_step: usize,
    c: Shared,
    c_step: usize,
}

impl Leaf for Accumulate {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        // SAFETY: the caller's: buffers with the padding that a product asks for.
        unsafe {
            let a = Left {
                start: self.a.pointer(),
                row_step: 1,
                k_step: self.a_step,
            };
            let b = Right::Rows {
                start: self.b.pointer(),
                step: self.b_step,
            };
            product::<S>(
                self.rows,
                self.depth,
                self.columns,
                a,
                b,
                self.c.pointer(),
                self.c_step,
                true,
            );
        }
    }
}

/// Takes some rows (inputs) of the gradient back to `[out, in, 3, 3]`.
struct Unpack<'a, const IN: usize> {
    gradient: &'a [f32],
    place_step: usize,
    row_step: usize,
    axes: Axes,
    rows: std::ops::Range<usize>,
    to: Shared,
}

impl<const IN: usize> Leaf for Unpack<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        const WIDEST: usize = 16;
        for k in self.rows {
            for first in (0..self.axes.columns).step_by(S::LANES) {
                let mut taps = [[0.0; WIDEST]; 9];
                // SAFETY: places hold whole vectors; the weights of these rows are this leaf's.
                unsafe {
                    let mut u = [[S::zero(); IN]; IN];
                    let from = self.gradient.as_ptr().add(k * self.row_step + first);
                    for place in 0..IN * IN {
                        u[place / IN][place % IN] = S::load(from.add(place * self.place_step));
                    }
                    let w = both!(line::weight_transposed::<S, IN>, S, IN, u);
                    for (tap, lanes) in taps.iter_mut().enumerate() {
                        S::store(lanes.as_mut_ptr(), w[tap / 3][tap % 3]);
                    }
                    for lane in 0..S::LANES.min(self.axes.columns - first) {
                        for (tap, lanes) in taps.iter().enumerate() {
                            *self.to.pointer().add(self.axes.place(k, first + lane, tap)) =
                                lanes[lane];
                        }
                    }
                }
            }
        }
    }
}

/// Values of both buffers of a chunk of tiles in [`gradient`].
const CHUNK_VALUES: usize = 1 << 20;

/// Tiles that one task transforms in [`gradient`]; also the stretches over which the bias is summed.
const TASK_TILES: usize = 32;

/// Gradient by the weight `[out, in, 3, 3]` and by the bias, `dy` gated where a gate is given.
#[allow(clippy::too_many_arguments, reason = "what a gradient is made of")]
pub(crate) fn gradient<const IN: usize>(
    isa: Isa,
    grid: Grid,
    x: &[f32],
    dy: &[f32],
    gate: Option<&[f32]>,
    dweight: &mut [f32],
    dbias: &mut [f32],
) {
    let (inputs, outputs) = (grid.channels(x.len()), grid.channels(dy.len()));
    assert_eq!(
        dweight.len(),
        outputs * inputs * 9,
        "a weight of {inputs} to {outputs} channels"
    );
    assert_eq!(dbias.len(), outputs, "a bias of {outputs} channels");
    assert!(
        gate.is_none_or(|gate| gate.len() == dy.len()),
        "the gate of a map of {} values",
        dy.len()
    );
    let (source, dy) = (
        Source {
            map: x,
            gate: None,
            channels: inputs,
        },
        Source {
            map: dy,
            gate,
            channels: outputs,
        },
    );
    let tiles = Tiles::new(grid, IN - 2);
    let (tall, wide) = (padded(isa, inputs), padded(isa, outputs));
    let chunk = (CHUNK_VALUES / (IN * IN * (tall + wide)))
        .next_multiple_of(TASK_TILES)
        .max(TASK_TILES);
    let chunk = chunk.min(tiles.count().next_multiple_of(TASK_TILES));
    let (v_step, z_step) = (place_step(chunk * tall + 32), place_step(chunk * wide));
    let mut v = Scratch::take(IN * IN * v_step);
    let mut z = Scratch::take(IN * IN * z_step);
    let rows = padded_rows(inputs);
    let u_step = place_step(rows * wide);
    let mut u = Scratch::zeroed(IN * IN * u_step);
    let tasks = tiles.count().div_ceil(TASK_TILES);
    let mut sums = Scratch::take(tasks * wide);
    let (v, z, u_shared, sums_shared) = (
        Shared::new(&mut v),
        Shared::new(&mut z),
        Shared::new(&mut u),
        Shared::new(&mut sums),
    );
    // Rows of the gradient a task: whole row blocks, so that tasks write nothing in common.
    let row_task = if rows >= 96 { 48 } else { rows };
    for first in (0..tiles.count()).step_by(chunk) {
        let count = chunk.min(tiles.count() - first);
        (0..count.div_ceil(TASK_TILES))
            .into_par_iter()
            .for_each(|task| {
                let index = task * TASK_TILES;
                let leaf = Taken::<IN> {
                    x: source,
                    dy,
                    tiles,
                    range: first + index..first + (index + TASK_TILES).min(count),
                    index,
                    v: (v, v_step, tall),
                    z: (z, z_step, wide),
                    dbias: sums_shared.offset(((first + index) / TASK_TILES) * wide),
                };
                // SAFETY: every tile of the chunk and every stretch of `sums` is written by one task.
                unsafe { run(isa, leaf) }
            });
        let row_tasks = rows.div_ceil(row_task);
        (0..IN * IN * row_tasks).into_par_iter().for_each(|task| {
            let (place, row) = (task / row_tasks, task % row_tasks * row_task);
            let leaf = Accumulate {
                rows: row_task.min(inputs.saturating_sub(row)),
                depth: count,
                columns: outputs,
                a: v.offset(place * v_step + row),
                a_step: tall,
                b: z.offset(place * z_step),
                b_step: wide,
                c: u_shared.offset(place * u_step + row * wide),
                c_step: wide,
            };
            // SAFETY: every row of every place of `u` is written by one task; `v` has 32 values beyond its last row, and
            // rows of `u` are padded.
            unsafe { run(isa, leaf) }
        });
    }
    for (o, dbias) in dbias.iter_mut().enumerate() {
        let sum: f64 = sums[o..].iter().step_by(wide).map(|x| f64::from(*x)).sum();
        *dbias = sum as f32;
    }
    let axes = Axes::new(outputs, inputs, false);
    let to = Shared::new(dweight);
    let step = (8192 / outputs).max(1);
    (0..inputs.div_ceil(step)).into_par_iter().for_each(|task| {
        let leaf = Unpack::<IN> {
            gradient: &u,
            place_step: u_step,
            row_step: wide,
            axes,
            rows: task * step..((task + 1) * step).min(inputs),
            to,
        };
        // SAFETY: tasks write the weights of different inputs.
        unsafe { run(isa, leaf) }
    });
}
