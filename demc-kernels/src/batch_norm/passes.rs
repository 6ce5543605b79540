//! The passes of [`super`] over some rows of a map, each on one thread. They are plain loops that
//! the compiler vectorises. Nothing is fused or reordered, so every path gives the same bits.

use crate::simd::{Leaf, Simd};

#[inline(always)]
fn by_channel(columns: &[f32], channels: usize) -> Vec<f64> {
    let mut sums = vec![0.0; channels];
    for pixel in columns.chunks(channels) {
        for (sum, value) in sums.iter_mut().zip(pixel) {
            *sum += f64::from(*value);
        }
    }
    sums
}

/// Mean of each channel of a block, and the sum of squared distances from it.
pub(super) struct BlockMoments<'a> {
    pub(super) x: &'a [f32],
    pub(super) width: usize,
    pub(super) channels: usize,
}

impl Leaf for BlockMoments<'_> {
    type Out = Vec<[f64; 2]>;

    /// Two passes over a block that the cache holds: first a mean, then the distances from it,
    /// whose sum corrects it.
    #[inline(always)]
    unsafe fn run<S: Simd>(self) -> Vec<[f64; 2]> {
        let pixels = (self.x.len() / self.channels) as f64;
        let mut sums = vec![0.0; self.width];
        for x in self.x.chunks(self.width) {
            for (sum, x) in sums.iter_mut().zip(x) {
                *sum += x;
            }
        }
        let near: Vec<f32> = by_channel(&sums, self.channels)
            .iter()
            .map(|sum| (sum / pixels) as f32)
            .collect();
        let center: Vec<f32> = near.iter().copied().cycle().take(self.width).collect();
        sums.fill(0.0);
        let mut squares = vec![0.0; self.width];
        for x in self.x.chunks(self.width) {
            for (((sum, square), x), center) in
                sums.iter_mut().zip(&mut squares).zip(x).zip(&center)
            {
                let distance = x - center;
                *sum += distance;
                *square += distance * distance;
            }
        }
        let sums = by_channel(&sums, self.channels);
        let moments = sums
            .iter()
            .zip(by_channel(&squares, self.channels))
            .zip(near);
        moments
            .map(|((sum, square), near)| {
                let square = square - sum * sum / pixels;
                // Rounding may give a value slightly below 0. NaN stays.
                let square = if square < 0.0 { 0.0 } else { square };
                [f64::from(near) + sum / pixels, square]
            })
            .collect()
    }
}

pub(super) struct Normalize<'a> {
    pub(super) x: &'a [f32],
    pub(super) mean: &'a [f32],
    pub(super) scale: &'a [f32],
    pub(super) beta: &'a [f32],
    pub(super) relu: bool,
    pub(super) y: &'a mut [f32],
}

impl Normalize<'_> {
    #[inline(always)]
    fn rows(self, rectify: impl Fn(f32) -> f32) {
        let width = self.mean.len();
        for (x, y) in self.x.chunks(width).zip(self.y.chunks_mut(width)) {
            let parameters = self.mean.iter().zip(self.scale).zip(self.beta);
            for ((x, y), ((mean, scale), beta)) in x.iter().zip(y).zip(parameters) {
                *y = rectify((x - mean) * scale + beta);
            }
        }
    }
}

impl Leaf for Normalize<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        if self.relu {
            self.rows(|value| if value < 0.0 { 0.0 } else { value });
        } else {
            self.rows(|value| value);
        }
    }
}

#[inline(always)]
fn gate(dy: f32, y: f32) -> f32 {
    if y > 0.0 { dy } else { 0.0 }
}

/// Sums over a block by channel, of `g` and of `g (x - mean)`.
pub(super) struct GradientSums<'a> {
    pub(super) x: &'a [f32],
    pub(super) y: &'a [f32],
    pub(super) dy: &'a [f32],
    pub(super) gated: bool,
    pub(super) mean: &'a [f32],
    pub(super) channels: usize,
}

impl GradientSums<'_> {
    #[inline(always)]
    fn rows(self, gate: impl Fn(f32, f32) -> f32) -> Vec<[f64; 2]> {
        let width = self.mean.len();
        let (mut plain, mut by_x) = (vec![0.0; width], vec![0.0; width]);
        let maps = self
            .x
            .chunks(width)
            .zip(self.y.chunks(width))
            .zip(self.dy.chunks(width));
        for ((x, y), dy) in maps {
            let sums = plain.iter_mut().zip(&mut by_x).zip(self.mean);
            for (((x, y), dy), ((plain, by_x), mean)) in x.iter().zip(y).zip(dy).zip(sums) {
                let g = gate(*dy, *y);
                *plain += g;
                *by_x += g * (x - mean);
            }
        }
        let sums = by_channel(&plain, self.channels);
        sums.into_iter()
            .zip(by_channel(&by_x, self.channels))
            .map(|(a, b)| [a, b])
            .collect()
    }
}

impl Leaf for GradientSums<'_> {
    type Out = Vec<[f64; 2]>;

    #[inline(always)]
    unsafe fn run<S: Simd>(self) -> Vec<[f64; 2]> {
        if self.gated {
            self.rows(gate)
        } else {
            self.rows(|dy, _| dy)
        }
    }
}

/// `dx = scale g + slope (x - mean) + shift`.
pub(super) struct InputGradient<'a> {
    pub(super) x: &'a [f32],
    pub(super) y: &'a [f32],
    pub(super) dy: &'a [f32],
    pub(super) gated: bool,
    pub(super) mean: &'a [f32],
    pub(super) scale: &'a [f32],
    pub(super) slope: &'a [f32],
    pub(super) shift: &'a [f32],
    pub(super) dx: &'a mut [f32],
}

impl InputGradient<'_> {
    #[inline(always)]
    fn rows(self, gate: impl Fn(f32, f32) -> f32) {
        let width = self.mean.len();
        let maps = self
            .x
            .chunks(width)
            .zip(self.y.chunks(width))
            .zip(self.dy.chunks(width));
        for (((x, y), dy), dx) in maps.zip(self.dx.chunks_mut(width)) {
            let parameters = self
                .mean
                .iter()
                .zip(self.scale)
                .zip(self.slope)
                .zip(self.shift);
            let maps = x.iter().zip(y).zip(dy).zip(dx);
            for ((((x, y), dy), dx), (((mean, scale), slope), shift)) in maps.zip(parameters) {
                *dx = scale * gate(*dy, *y) + (slope * (x - mean) + shift);
            }
        }
    }
}

impl Leaf for InputGradient<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        if self.gated {
            self.rows(gate)
        } else {
            self.rows(|dy, _| dy)
        }
    }
}
