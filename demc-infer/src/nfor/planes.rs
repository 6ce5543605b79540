//! Images of any number of channels, and their division into tiles.

use std::ops::Range;

use rayon::prelude::*;

/// An image, `[C, H, W]`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Planes {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) samples: Vec<f32>,
}

impl Planes {
    pub(super) fn zeros(channels: usize, height: usize, width: usize) -> Self {
        Self {
            width,
            height,
            samples: vec![0.0; channels * height * width],
        }
    }

    pub(super) fn pixels(&self) -> usize {
        self.width * self.height
    }

    pub(super) fn channels(&self) -> usize {
        self.samples.len() / self.pixels().max(1)
    }

    pub(super) fn plane(&self, channel: usize) -> &[f32] {
        &self.samples[channel * self.pixels()..][..self.pixels()]
    }

    /// A row of a channel, from column `x` on.
    pub(super) fn row(&self, channel: usize, y: usize, x: usize) -> &[f32] {
        &self.plane(channel)[y * self.width + x..(y + 1) * self.width]
    }

    /// An image of the same size whose samples are `make` of those of two images.
    pub(super) fn of(a: &Self, b: &Self, make: impl Fn(f32, f32) -> f32 + Sync) -> Self {
        let pairs = a.samples.par_iter().zip(&b.samples);
        Self {
            samples: pairs.map(|(a, b)| make(*a, *b)).collect(),
            ..*a
        }
    }

    /// Some of the channels.
    pub(super) fn part(&self, channels: Range<usize>) -> Self {
        let pixels = self.pixels();
        Self {
            samples: self.samples[channels.start * pixels..channels.end * pixels].to_vec(),
            ..*self
        }
    }

    /// The channels of several images of one size.
    pub(super) fn stacked(images: &[Self]) -> Self {
        let samples = images.iter().flat_map(|image| &image.samples);
        Self {
            samples: samples.copied().collect(),
            ..images[0]
        }
    }
}

/// Side of a tile in pixels: the weights of its windows fit into a core's cache.
pub(super) const TILE: usize = 32;

/// The upper left pixel of a tile. Tiles at the right and lower edge of an image go beyond it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tile {
    pub(super) y: usize,
    pub(super) x: usize,
}

/// The tiles of an image.
pub(super) fn tiles(height: usize, width: usize) -> Vec<Tile> {
    let rows = (0..height).step_by(TILE);
    rows.flat_map(|y| (0..width).step_by(TILE).map(move |x| Tile { y, x }))
        .collect()
}
