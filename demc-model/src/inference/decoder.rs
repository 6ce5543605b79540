//! The decoder: each level in place of the skips' share of its fusion, of large ones only a band not yet fused. The last
//! level of a large image is `step`'s.

use demc_kernels::conv1x1::{self, Finish};
use demc_kernels::{Grid, deconv4x4, grid, memory};

use super::encoder::{Encoded, bands};
use super::layer::Layer;
use super::{Maps, Run};
use crate::decoder::DecoderLevel;

impl Run<'_> {
    /// Planar images `[B, 3, H, W]` from what the encoders left.
    pub(super) fn decode(&self, encoded: Encoded) -> Vec<f32> {
        let Encoded {
            sums,
            again,
            bottom,
        } = encoded;
        let latent = &self.model.latent;
        let mut x = self.conv3x3(&bottom, &Layer::conv(&latent.conv, latent.norm.as_ref()));
        drop(bottom);
        let decoder = &self.model.decoder;
        for (level, sum) in decoder.levels.iter().zip(sums.into_iter().rev()) {
            x = self.ascend(level, &x, sum);
        }
        match again {
            Some(again) => self.finish_in_step(&x, again),
            None => {
                let image = self.conv3x3(&x, &Layer::conv(&decoder.head, None));
                let mut planar = memory::buffer(image.values.len());
                grid::nchw_from_nhwc(image.grid, &image.values, &mut planar);
                planar
            }
        }
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
}
