//! The decoder: each level in place of the skips' share of its fusion, of large ones only a band not yet fused. The last
//! level of a large image is `step`'s.

use std::ops::Range;

use demc_kernels::conv1x1::{self, Finish};
use demc_kernels::{Grid, Isa, deconv4x4, memory};

use super::band::bands;
use super::layer::Layer;
use super::{Maps, Run};
use crate::decoder::DecoderLevel;

impl Run<'_> {
    /// A level: `sum` is the skips' share of its fusion and becomes its output.
    pub(super) fn ascend(&self, level: &DecoderLevel, below: &Maps, mut sum: Maps) -> Maps {
        let layers = level_layers(level);
        let ascent = self.ascent(level, &layers);
        let grid = sum.grid;
        if !self.plan.is_banded(grid) {
            ascent.finish(below.grid, &below.values, 0, &mut sum.values);
            return sum;
        }
        for image in 0..grid.batch {
            for rows in bands(grid.height, self.plan.band) {
                ascent.finish_rows(below, image, rows.clone(), sum.rows_mut(image, rows));
            }
        }
        sum
    }

    /// A level's `layers`, ready.
    pub(super) fn ascent<'a>(&self, level: &DecoderLevel, layers: &'a [Layer; 2]) -> Ascent<'a> {
        let [deconv, fuse] = layers;
        Ascent {
            isa: self.isa,
            deconv: deconv4x4::Ready::new(self.isa, deconv.weight(), deconv.bias(), true),
            fuse,
            finish: Finish {
                bias: Some(fuse.bias()),
                relu: level.activated_fusion,
                add: true,
            },
        }
    }
}

/// Deconvolution and skip fusion.
pub(super) fn level_layers(level: &DecoderLevel) -> [Layer; 2] {
    [
        Layer::deconv(&level.deconv, level.norm.as_ref()),
        Layer::conv(&level.fuse, None),
    ]
}

/// A level of the decoder, ready for what the encoders gave to its fusion.
pub(super) struct Ascent<'a> {
    isa: Isa,
    deconv: deconv4x4::Ready<'a>,
    fuse: &'a Layer,
    finish: Finish<'a>,
}

impl Ascent<'_> {
    /// Adds the decoder's share of the fusion to that of the skips in `sum`, rows of an image that begin and end with a
    /// pair, and finishes them.
    pub(super) fn finish_rows(
        &self,
        below: &Maps,
        image: usize,
        rows: Range<usize>,
        sum: &mut [f32],
    ) {
        let (window, above) = below.with_neighbours(rows.start / 2..rows.end / 2);
        let x = below.rows(image, window.clone());
        self.finish(below.band(window.len()), x, above, sum);
    }

    /// The same of the rows of `x` from `above` on, as many as `sum` has pairs.
    fn finish(&self, grid: Grid, x: &[f32], above: usize, sum: &mut [f32]) {
        let mut decoded = memory::buffer(sum.len());
        self.deconv.forward(grid, x, above, &mut decoded);
        let made = Grid {
            height: sum.len() / (grid.batch * 2 * grid.width * self.fuse.outputs()),
            ..grid.doubled()
        };
        let (weight, finish) = (self.fuse.weight(), self.finish);
        conv1x1::part(self.isa, made, &[&decoded], weight, 0, finish, sum);
    }
}
