//! The decoder: each level in bands, in place of the skips' share of its fusion.

use demc_kernels::conv1x1::{self, Finish};
use demc_kernels::{Grid, conv3x3, deconv4x4, memory};

use super::encoder::{Encoded, bands};
use super::layer::Layer;
use super::{Maps, Run};
use crate::config::COLOR_CHANNELS;
use crate::decoder::DecoderLevel;

impl Run<'_> {
    /// Planar images `[B, 3, H, W]` from what the encoders left.
    pub(super) fn decode(&self, encoded: Encoded) -> Vec<f32> {
        let Encoded { sums, bottom } = encoded;
        let latent = &self.model.latent;
        let mut x = self.conv3x3(&bottom, &Layer::conv(&latent.conv, latent.norm.as_ref()));
        drop(bottom);
        let decoder = &self.model.decoder;
        for (level, sum) in decoder.levels.iter().zip(sums.into_iter().rev()) {
            x = self.ascend(level, &x, sum);
        }
        self.head(&x, &Layer::conv(&decoder.head, None))
    }

    /// A level: `sum` is the skips' share of its fusion and becomes its output.
    fn ascend(&self, level: &DecoderLevel, below: &Maps, mut sum: Maps) -> Maps {
        let layer = Layer::deconv(&level.deconv, level.norm.as_ref());
        let deconv = deconv4x4::Ready::new(self.isa, layer.weight(), layer.bias(), true);
        let fuse = Layer::conv(&level.fuse, None);
        let finish = Finish {
            bias: Some(fuse.bias()),
            relu: level.activated_fusion,
            add: true,
        };
        let grid = sum.grid;
        let fuse = |grid: Grid, decoded: &[f32], sum: &mut [f32]| {
            conv1x1::part(self.isa, grid, &[decoded], fuse.weight(), 0, finish, sum);
        };
        if !self.plan.is_banded(grid) {
            let mut decoded = memory::buffer(grid.pixels() * layer.outputs());
            deconv.forward(below.grid, &below.values, 0, &mut decoded);
            fuse(grid, &decoded, &mut sum.values);
            return sum;
        }
        let band = self.plan.band;
        let mut decoded = memory::buffer(band * grid.width * layer.outputs());
        for image in 0..grid.batch {
            for rows in bands(below.grid.height, band / 2) {
                let (window, above) = below.with_neighbours(rows.clone());
                let made = 2 * rows.start..2 * rows.end;
                let decoded = &mut decoded[..made.len() * grid.width * layer.outputs()];
                let x = below.rows(image, window.clone());
                deconv.forward(below.band(window.len()), x, above, decoded);
                fuse(sum.band(made.len()), decoded, sum.rows_mut(image, made));
            }
        }
        sum
    }

    /// The output convolution, planar.
    fn head(&self, x: &Maps, layer: &Layer) -> Vec<f32> {
        let Grid { height, width, .. } = x.grid;
        let (weight, bias) = (layer.weight(), layer.bias());
        let conv = conv3x3::Ready::new(self.isa, self.tile, weight, bias, true);
        let mut planar = memory::buffer(x.grid.pixels() * COLOR_CHANNELS);
        let band = self.plan.band_rows(x.grid);
        let mut colors = memory::buffer(band * width * COLOR_CHANNELS);
        for (image, planar) in planar
            .chunks_exact_mut(height * width * COLOR_CHANNELS)
            .enumerate()
        {
            for rows in bands(height, band) {
                let (window, above) = x.with_neighbours(rows.clone());
                let colors = &mut colors[..rows.len() * width * COLOR_CHANNELS];
                let grid = x.band(window.len());
                conv.forward(grid, x.rows(image, window), above, colors);
                for (channel, plane) in planar.chunks_exact_mut(height * width).enumerate() {
                    let plane = &mut plane[rows.start * width..rows.end * width];
                    let colors = colors.chunks_exact(COLOR_CHANNELS);
                    for (to, color) in plane.iter_mut().zip(colors) {
                        *to = color[channel];
                    }
                }
            }
        }
        planar
    }
}
