//! Collaborative first-order regression (Sec. 4 and 5.2). In the window around each pixel, a linear
//! function of features and place fits the colour, with the weights of NL-means. The fit serves all pixels
//! of the window: each pixel gets the weighted mean of all fits that it is part of.

use multiversion::multiversion;
use rayon::prelude::*;

use super::planes::{Planes, TILE, Tile, tiles};
use super::solve::{ALL, COLORS, COLUMNS, Coefficients, LANES, Lanes, Sums, solve};
use super::weights::{Guide, Scratch, TILE_PIXELS, shifts, weights};

/// Radius of a window (Sec. 5.2: 19x19 pixels).
const RADIUS: usize = 9;
/// Side of a window.
const WINDOW: usize = 2 * RADIUS + 1;
/// Neighbours in a window, the pixel itself included.
const NEIGHBOURS: usize = WINDOW * WINDOW;
/// Channels of the features: normal, albedo, depth.
pub(super) const FEATURES: usize = COLUMNS - 3;
/// Side of a tile with the windows of its pixels.
const SIDE: usize = TILE + 2 * RADIUS;
/// Tiles whose results are in memory at a time; results are added in their order.
const BATCH: usize = 256;

/// What is fitted, and by what.
pub(super) struct Regression<'a> {
    /// `[3, H, W]`.
    pub(super) color: &'a Planes,
    /// `[7, H, W]`.
    pub(super) features: &'a Planes,
    pub(super) guide: Guide<'a>,
}

impl Regression<'_> {
    /// The fitted colour for each bandwidth.
    pub(super) fn fit<const K: usize>(&self, bandwidths: [f32; K]) -> [Planes; K] {
        let (height, width) = (self.color.height, self.color.width);
        // Colour and weight.
        let mut sums = [(); K].map(|()| Planes::zeros(COLORS + 1, height, width));
        for batch in tiles(height, width).chunks(BATCH) {
            let fitted: Vec<[Vec<f32>; K]> = batch
                .par_iter()
                .map_init(Memory::new, |memory, tile| {
                    self.distances(*tile, memory);
                    let block = self.block(*tile);
                    bandwidths.map(|bandwidth| {
                        weights(bandwidth, &memory.distances, &mut memory.weights);
                        let mut out = vec![0.0; (COLORS + 1) * SIDE * SIDE];
                        fit_tile(&block, &memory.weights, &mut out);
                        out
                    })
                })
                .collect();
            for (tile, fitted) in batch.iter().zip(&fitted) {
                for (sums, fitted) in sums.iter_mut().zip(fitted) {
                    add_tile(sums, *tile, fitted);
                }
            }
        }
        sums.map(|mut sums| {
            let (colors, weights) = sums.samples.split_at_mut(COLORS * height * width);
            for color in colors.chunks_exact_mut(weights.len()) {
                let pixels = color.par_iter_mut().zip(&*weights);
                pixels.for_each(|(color, weight)| *color /= weight);
            }
            sums.samples.truncate(COLORS * height * width);
            sums
        })
    }

    /// The distances of all neighbours, `[NEIGHBOURS, TILE, TILE]`.
    fn distances(&self, tile: Tile, memory: &mut Memory) {
        let planes = memory.distances.chunks_exact_mut(TILE_PIXELS);
        for (shift, distances) in shifts(RADIUS).zip(planes) {
            let scratch = &mut memory.scratch;
            self.guide.distances(tile, shift, scratch, distances);
        }
    }

    /// Features and colour of a tile and its windows, `[7 + 3, SIDE, SIDE]`, with 0 beyond the image.
    fn block(&self, tile: Tile) -> Vec<f32> {
        let mut block = vec![0.0; (FEATURES + COLORS) * SIDE * SIDE];
        for (channel, block) in block.chunks_exact_mut(SIDE * SIDE).enumerate() {
            let (image, channel) = match channel.checked_sub(FEATURES) {
                None => (self.features, channel),
                Some(color) => (self.color, color),
            };
            let (first, skipped) = start(tile.x);
            for (i, block) in block.chunks_exact_mut(SIDE).enumerate() {
                let y = (tile.y + i).wrapping_sub(RADIUS);
                if y < image.height {
                    let row = image.row(channel, y, first);
                    let count = row.len().min(SIDE - skipped);
                    block[skipped..skipped + count].copy_from_slice(&row[..count]);
                }
            }
        }
        block
    }
}

/// The first place of a block along one axis, and the number of its places that are before the image.
fn start(tile: usize) -> (usize, usize) {
    (tile.saturating_sub(RADIUS), RADIUS.saturating_sub(tile))
}

/// Memory of a thread.
struct Memory {
    distances: Vec<f32>,
    weights: Vec<f32>,
    scratch: Scratch,
}

impl Memory {
    fn new() -> Self {
        let plane = || vec![0.0; NEIGHBOURS * TILE_PIXELS];
        Self {
            distances: plane(),
            weights: plane(),
            scratch: Scratch::new(),
        }
    }
}

/// Adds the results of a tile and its windows, `[4, SIDE, SIDE]`, to the image.
fn add_tile(sums: &mut Planes, tile: Tile, fitted: &[f32]) {
    let (height, width, pixels) = (sums.height, sums.width, sums.pixels());
    let (first, skipped) = start(tile.x);
    let count = (width - first).min(SIDE - skipped);
    for (i, row) in fitted.chunks_exact(SIDE).enumerate() {
        let (channel, i) = (i / SIDE, i % SIDE);
        let y = (tile.y + i).wrapping_sub(RADIUS);
        if y < height {
            let out = &mut sums.samples[channel * pixels + y * width + first..][..count];
            for (out, value) in out.iter_mut().zip(&row[skipped..]) {
                *out += value;
            }
        }
    }
}

/// Fits all pixels of a tile, and adds colour and weight of the fits to `out`.
///
/// # Shapes
/// `block` as made by [`Regression::block`], `weights` `[NEIGHBOURS, TILE, TILE]`, `out`
/// `[4, SIDE, SIDE]`.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn fit_tile(block: &[f32], weights: &[f32], out: &mut [f32]) {
    let mut row = Row {
        weights: [[0.0; LANES]; WINDOW],
        values: [[[0.0; LANES]; WINDOW]; ALL],
    };
    for y in 0..TILE {
        for x in (0..TILE).step_by(LANES) {
            let pixels = Pixels {
                block,
                weights,
                y,
                x,
            };
            let means = pixels.means(&mut row);
            let coefficients = solve(&pixels.sums(&means, &mut row));
            pixels.distribute(&means, &coefficients, &mut row, out);
        }
    }
}

/// Some pixels side by side.
struct Pixels<'a> {
    block: &'a [f32],
    weights: &'a [f32],
    /// Their place in the tile.
    y: usize,
    x: usize,
}

impl Pixels<'_> {
    /// Reads a row of the windows: weights, and columns and colours minus `centers`. Columns are 1, the place
    /// minus that of the pixel, and features.
    #[inline(always)]
    fn read(&self, y: usize, centers: &[Lanes; ALL], row: &mut Row) {
        for x in 0..WINDOW {
            let neighbour = y * WINDOW + x;
            let start = neighbour * TILE_PIXELS + self.y * TILE + self.x;
            row.weights[x] = lanes(self.weights, start);
            row.values[1][x] = [x as f32 - RADIUS as f32; LANES];
        }
        row.values[0] = [[1.0; LANES]; WINDOW];
        row.values[2] = [[y as f32 - RADIUS as f32; LANES]; WINDOW];
        let first = self.index(y);
        for (channel, values) in row.values[3..].iter_mut().enumerate() {
            for (x, value) in values.iter_mut().enumerate() {
                *value = lanes(self.block, channel * SIDE * SIDE + first + x);
            }
        }
        for (values, center) in row.values.iter_mut().zip(centers) {
            let centers = [*center; WINDOW];
            let values = values.as_flattened_mut().iter_mut();
            for (value, center) in values.zip(centers.as_flattened()) {
                *value -= center;
            }
        }
    }

    /// The index in the block of the first neighbour in a row of the windows.
    #[inline(always)]
    fn index(&self, y: usize) -> usize {
        (self.y + y) * SIDE + self.x
    }

    /// The weighted means over the window, and 0 in place of the column of ones. Columns minus their means
    /// hardly depend on each other, which float32 needs.
    #[inline(always)]
    fn means(&self, row: &mut Row) -> [Lanes; ALL] {
        // Means of differences from the pixel, so that a constant feature has exactly its value.
        let mut own = [[0.0; LANES]; ALL];
        for (channel, own) in own[3..].iter_mut().enumerate() {
            *own = lanes(
                self.block,
                channel * SIDE * SIDE + self.index(RADIUS) + RADIUS,
            );
        }
        let mut sums = [[0.0; LANES]; ALL];
        for y in 0..WINDOW {
            self.read(y, &own, row);
            for (sum, values) in sums.iter_mut().zip(&row.values) {
                let product = product(&row.weights, values);
                for l in 0..LANES {
                    sum[l] += product[l];
                }
            }
        }
        // Without any weight, the pixels are beyond the image.
        let total = sums[0].map(|total| total.max(f32::MIN_POSITIVE));
        let mut means = own;
        for (mean, sum) in means.iter_mut().zip(&sums).skip(1) {
            for l in 0..LANES {
                mean[l] += sum[l] / total[l];
            }
        }
        means
    }

    /// The sums of weighted products of columns and colours over the window, all minus `means`. Each row of
    /// the window is added up in registers first.
    #[inline(always)]
    fn sums(&self, means: &[Lanes; ALL], row: &mut Row) -> Sums {
        let mut sums = [[[0.0; LANES]; ALL]; COLUMNS];
        for y in 0..WINDOW {
            self.read(y, means, row);
            for (i, sums) in sums.iter_mut().enumerate() {
                let mut weighted = row.values[i];
                let values = weighted.as_flattened_mut().iter_mut();
                for (value, weight) in values.zip(row.weights.as_flattened()) {
                    *value *= weight;
                }
                for (sum, values) in sums.iter_mut().zip(&row.values).skip(i) {
                    let product = product(&weighted, values);
                    for l in 0..LANES {
                        sum[l] += product[l];
                    }
                }
            }
        }
        sums
    }

    /// Adds the fitted colours of the windows, and their weights.
    #[inline(always)]
    fn distribute(
        &self,
        means: &[Lanes; ALL],
        coefficients: &Coefficients,
        row: &mut Row,
        out: &mut [f32],
    ) {
        for y in 0..WINDOW {
            self.read(y, means, row);
            for x in 0..WINDOW {
                let weight = row.weights[x];
                for channel in 0..=COLORS {
                    let mut color = [1.0; LANES];
                    if channel < COLORS {
                        color = means[COLUMNS + channel];
                        for (values, coefficients) in row.values.iter().zip(coefficients) {
                            for l in 0..LANES {
                                color[l] += values[x][l] * coefficients[channel][l];
                            }
                        }
                    }
                    let start = channel * SIDE * SIDE + self.index(y) + x;
                    let mut sum = lanes(out, start);
                    for l in 0..LANES {
                        sum[l] += weight[l] * color[l];
                    }
                    out[start..start + LANES].copy_from_slice(&sum);
                }
            }
        }
    }
}

/// A row of the windows of some pixels.
struct Row {
    weights: [Lanes; WINDOW],
    /// Columns and colours.
    values: [[Lanes; WINDOW]; ALL],
}

/// The sum of the products of two rows. Its order is fixed, so that the compiler uses one lane of a
/// vector for each pixel, and not for each neighbour.
#[inline(always)]
fn product(a: &[Lanes; WINDOW], b: &[Lanes; WINDOW]) -> Lanes {
    let mut sum = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for l in 0..LANES {
            sum[l] += a[l] * b[l];
        }
    }
    sum
}

#[inline(always)]
fn lanes(samples: &[f32], start: usize) -> Lanes {
    let mut lanes = [0.0; LANES];
    lanes.copy_from_slice(&samples[start..start + LANES]);
    lanes
}
