//! The encoder of the features beside a U-Net (`crate::side_encoder`), level by level in bands. Its maps are
//! kept until the decoder reaches their level.

use std::ops::Range;

use demc_kernels::conv1x1::{Epilogue, Part, forward_part};
use demc_kernels::{Isa, memory, pool};

use super::encoder::folded_block;
use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::unet_pass::{ImagePlanes, UnetPass, folded};
use super::watch::Cancelled;
use crate::config::FEATURE_CHANNELS;
use crate::side_encoder::SideEncoder;
use crate::unet::UNET_LEVELS;

pub(super) struct SideMaps {
    /// The encoder's map of each level, from the full resolution down.
    maps: Vec<FeatureMaps>,
    /// The fusion of each level, from the full resolution down.
    fuses: Vec<FoldedConv>,
}

impl SideMaps {
    /// Runs the encoder; `features` are all twelve of each image.
    pub(super) fn new(
        pass: &UnetPass,
        encoder: &SideEncoder,
        features: &ImagePlanes,
    ) -> Result<Self, Cancelled> {
        let mut maps: Vec<FeatureMaps> = Vec::with_capacity(UNET_LEVELS);
        let mut below: Option<FeatureMaps> = None;
        for (level, module) in encoder.levels.iter().enumerate() {
            let grid = (0..level).fold(features.grid, |grid, _| grid.halved());
            let fusion = encoder.fusion.as_ref().filter(|_| level == 0);
            let blocks = fusion.iter().flat_map(|fusion| &fusion.blocks);
            let convs: Vec<FoldedConv> = blocks.map(folded_block).chain(folded(module)).collect();
            let outputs = convs.last().expect("a convolution").outputs();
            let mut map = FeatureMaps::new(grid, outputs);
            let mut pooled =
                (level + 1 < UNET_LEVELS).then(|| FeatureMaps::new(grid.halved(), outputs));
            pass.run(
                &convs,
                grid,
                |image, rows, target| match &below {
                    None => features.interleave(image, rows, 0..FEATURE_CHANNELS, target),
                    Some(below) => target.copy_from_slice(below.rows(image, rows)),
                },
                |conv, image, rows, values| {
                    if conv + 1 < convs.len() {
                        return;
                    }
                    if let Some(pooled) = &mut pooled {
                        let target = pooled.rows_mut(image, rows.start / 2..rows.end / 2);
                        pool::forward(Isa::current(), map.band(rows.len()), values, target);
                    }
                    map.rows_mut(image, rows).copy_from_slice(values);
                },
            )?;
            maps.push(map);
            below = pooled;
        }
        let fuses = encoder.fuses.iter().rev();
        Ok(SideMaps {
            maps,
            fuses: fuses.map(|conv| FoldedConv::conv(conv, None)).collect(),
        })
    }

    /// Adds this encoder's map to rows of the decoder's map of a level.
    pub(super) fn fuse(&self, level: usize, image: usize, rows: Range<usize>, decoded: &mut [f32]) {
        let (map, fuse) = (&self.maps[level], &self.fuses[level]);
        let part = Part {
            weight: fuse.weight(),
            first: 0,
            epilogue: Epilogue {
                bias: Some(fuse.bias()),
                relu: true,
                add: false,
            },
        };
        let mut fused = memory::buffer(decoded.len());
        let inputs = [&*decoded, map.rows(image, rows.clone())];
        forward_part(
            Isa::current(),
            map.band(rows.len()),
            &inputs,
            part,
            &mut fused,
        );
        decoded.copy_from_slice(&fused);
    }

    /// Frees the map of a level.
    pub(super) fn free(&mut self, level: usize) {
        self.maps[level].values = Vec::new();
    }
}
