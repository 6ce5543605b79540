//! The decoder's levels. Each output replaces the skips' share of the level's fusion; large maps
//! are computed in bands. `full_resolution` computes the last level of a large image.

use std::ops::Range;

use demc_kernels::conv1x1::{Epilogue, Part, forward_part};
use demc_kernels::deconv4x4::PreparedDeconvolution;
use demc_kernels::{Grid, Isa, memory};

use super::band::bands;
use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::pass::InferencePass;
use super::watch::Cancelled;
use crate::decoder::DecoderLevel;

impl InferencePass<'_> {
    pub(super) fn decode_level(
        &self,
        level: &DecoderLevel,
        below: &FeatureMaps,
        mut sum: FeatureMaps,
    ) -> Result<FeatureMaps, Cancelled> {
        let convs = folded_level(level);
        let prepared = self.prepare_level(level, &convs);
        let grid = sum.grid;
        if !self.plan.is_banded(grid) {
            prepared.fuse(below.grid, &below.values, 0, &mut sum.values);
            self.watch.add(grid.pixels())?;
            return Ok(sum);
        }
        for image in 0..grid.batch {
            for rows in bands(grid.height, self.plan.band) {
                self.watch.add(rows.len() * grid.width)?;
                prepared.fuse_rows(below, image, rows.clone(), sum.rows_mut(image, rows));
            }
        }
        Ok(sum)
    }

    /// The level with its prepared weights; `convs` are those of [`folded_level`].
    pub(super) fn prepare_level<'a>(
        &self,
        level: &DecoderLevel,
        convs: &'a [FoldedConv; 2],
    ) -> PreparedLevel<'a> {
        let [deconv, fusion] = convs;
        PreparedLevel {
            isa: self.isa,
            deconv: PreparedDeconvolution::new(self.isa, deconv.rectified()),
            fusion,
            epilogue: Epilogue {
                bias: Some(fusion.bias()),
                relu: level.activated_fusion,
                add: true,
            },
        }
    }
}

pub(super) fn folded_level(level: &DecoderLevel) -> [FoldedConv; 2] {
    [
        FoldedConv::deconv(&level.deconv, level.norm.as_ref()),
        FoldedConv::conv(&level.fuse, None),
    ]
}

pub(super) struct PreparedLevel<'a> {
    isa: Isa,
    deconv: PreparedDeconvolution<'a>,
    fusion: &'a FoldedConv,
    epilogue: Epilogue<'a>,
}

impl PreparedLevel<'_> {
    /// Completes the fusion of some rows of an image: adds the decoder's share to that of the skips
    /// in `sum`. The rows begin and end at even numbers.
    pub(super) fn fuse_rows(
        &self,
        below: &FeatureMaps,
        image: usize,
        rows: Range<usize>,
        sum: &mut [f32],
    ) {
        let (window, above) = below.with_neighbours(rows.start / 2..rows.end / 2);
        let x = below.rows(image, window.clone());
        self.fuse(below.band(window.len()), x, above, sum);
    }

    /// The same for the rows of `x` from `above` on; `sum` has two rows for each.
    fn fuse(&self, grid: Grid, x: &[f32], above: usize, sum: &mut [f32]) {
        let mut decoded = memory::buffer(sum.len());
        self.deconv.forward(grid, x, above, &mut decoded);
        let decoded_grid = Grid {
            height: sum.len() / (grid.batch * 2 * grid.width * self.fusion.outputs()),
            ..grid.doubled()
        };
        let part = Part {
            weight: self.fusion.weight(),
            first: 0,
            epilogue: self.epilogue,
        };
        forward_part(self.isa, decoded_grid, &[&decoded], part, sum);
    }
}
