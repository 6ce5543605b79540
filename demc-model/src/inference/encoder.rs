//! The encoders, level by level, on whole maps or on bands.

use std::ops::Range;

use demc_kernels::conv1x1::{Epilogue, Part, forward_part};
use demc_kernels::conv3x3::PreparedConvolution;
use demc_kernels::{Grid, pool};

use super::band::{BandedConv, ConvChain, RowWindow, bands};
use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::images::InputImages;
use super::pass::InferencePass;
use super::watch::Cancelled;
use crate::config::{Input, LEVELS};
use crate::encoder::EncoderLevel;
use crate::fusion::Fusion;
use crate::layers::ConvBlock;

/// Deepest level that is computed in bands. Below it, a map is smaller than the prepared weights of
/// its convolutions.
pub(super) const DEEPEST_BANDED: usize = 2;

impl InferencePass<'_> {
    /// The inputs of all encoders, as whole maps.
    pub(super) fn encoder_inputs(&self, images: InputImages) -> Vec<FeatureMaps> {
        let spec = self.model.config().variant.spec();
        let detail = spec.has_fusion().then(|| {
            let features = images.interleaved(&[Input::Features], None);
            let blocks = self.fusion().blocks.iter();
            blocks.fold(features, |x, block| self.conv3x3(&x, &folded_block(block)))
        });
        let parts = spec.encoders.iter();
        parts
            .map(|parts| images.interleaved(parts, detail.as_ref()))
            .collect()
    }

    fn fusion(&self) -> &Fusion {
        let fusion = self.model.fusion.as_ref();
        fusion.expect("a variant with a detail map has a fusion")
    }

    /// Computes a level of all encoders on whole maps: `inputs` become those of the level below.
    /// Returns the skips' share of the level's fusion.
    pub(super) fn encode_level(
        &self,
        level: usize,
        inputs: &mut Vec<FeatureMaps>,
    ) -> Result<FeatureMaps, Cancelled> {
        let grid = inputs[0].grid;
        let fusion = self.skip_fusion(level);
        let mut sum = FeatureMaps::new(grid, fusion.outputs());
        for (index, input) in std::mem::take(inputs).into_iter().enumerate() {
            let level = &self.model.encoders[index].levels[level];
            let mut x = input;
            for (number, conv) in level.convs.iter().enumerate() {
                x = self.conv3x3(&x, &FoldedConv::conv(conv, None));
                if number + 1 == level.skip_after {
                    self.add_skip(index, grid, &x.values, &fusion, &mut sum.values);
                }
            }
            if level.pooled {
                let mut below = FeatureMaps::new(grid.halved(), x.channels());
                pool::forward(self.isa, grid, &x.values, &mut below.values);
                inputs.push(below);
            }
        }
        self.watch.add(grid.pixels())?;
        Ok(sum)
    }

    /// Adds an encoder's share of a fusion to `sum`, which holds the shares of the encoders before
    /// it.
    pub(super) fn add_skip(
        &self,
        encoder: usize,
        grid: Grid,
        skip: &[f32],
        fusion: &FoldedConv,
        sum: &mut [f32],
    ) {
        // The decoder's channels are the first inputs of the fusion.
        let part = Part {
            weight: fusion.weight(),
            first: (1 + encoder) * fusion.outputs(),
            epilogue: Epilogue {
                add: encoder > 0,
                ..Epilogue::default()
            },
        };
        forward_part(self.isa, grid, &[skip], part, sum);
    }

    /// The same on bands, encoder by encoder.
    pub(super) fn encode_level_in_bands(
        &self,
        level: usize,
        inputs: &mut Vec<FeatureMaps>,
    ) -> Result<FeatureMaps, Cancelled> {
        let grid = inputs[0].grid;
        let fusion = self.skip_fusion(level);
        let mut sum = FeatureMaps::new(grid, fusion.outputs());
        let mut below = Vec::with_capacity(inputs.len());
        let encoders = inputs.len();
        for (index, input) in std::mem::take(inputs).into_iter().enumerate() {
            let convs = self.folded_levels(index, level..level + 1);
            let mut levels = self.banded_levels(index, level..level + 1, grid, &convs);
            let mut pooled = self.pooled_map(index, level, grid);
            for image in 0..grid.batch {
                levels.iter_mut().for_each(|level| level.chain.restart());
                for rows in bands(grid.height, self.plan.band) {
                    self.watch.add(rows.len() * grid.width / encoders)?;
                    let target = levels[0].chain.input().push(rows.len());
                    target.copy_from_slice(input.rows(image, rows));
                    self.advance(&mut levels, image, pooled.as_mut(), |_, rows, skip| {
                        let band = sum.band(rows.len());
                        self.add_skip(index, band, skip, &fusion, sum.rows_mut(image, rows));
                    });
                }
            }
            below.extend(pooled);
        }
        *inputs = below;
        Ok(sum)
    }

    /// Computes all rows of `levels` that the input of the first one allows. The pooled rows of the
    /// last level go into `below`. `observe` receives each level's index, the rows of its skip, and
    /// their values.
    pub(super) fn advance(
        &self,
        levels: &mut [BandedLevel],
        image: usize,
        mut below: Option<&mut FeatureMaps>,
        mut observe: impl FnMut(usize, Range<usize>, &[f32]),
    ) {
        for index in 0..levels.len() {
            let (upper, lower) = levels.split_at_mut(index + 1);
            let BandedLevel { chain, skip_after } = &mut upper[index];
            chain.advance(|conv, rows, values| {
                if conv + 1 == *skip_after {
                    observe(index, rows, values);
                }
            });
            let (grid, output) = chain.output.all();
            let range = chain.output.range();
            let pooled = match (lower.first_mut(), &mut below) {
                _ if range.is_empty() => None,
                (Some(level), _) => Some(level.chain.input().push(range.len() / 2)),
                (None, Some(below)) => Some(below.rows_mut(image, range.start / 2..range.end / 2)),
                // An encoder that does not feed the latent ends with its last skip.
                (None, None) => None,
            };
            if let Some(pooled) = pooled {
                pool::forward(self.isa, grid, output, pooled);
            }
            chain.output.free_all();
        }
    }

    pub(super) fn folded_levels(
        &self,
        encoder: usize,
        levels: Range<usize>,
    ) -> Vec<Vec<FoldedConv>> {
        let levels = &self.model.encoders[encoder].levels[levels];
        levels
            .iter()
            .map(|level| {
                let convs = level.convs.iter();
                convs.map(|conv| FoldedConv::conv(conv, None)).collect()
            })
            .collect()
    }

    /// Some levels of an encoder for bands of maps, the first level on `grid`. `convs` are those of
    /// [`Self::folded_levels`].
    pub(super) fn banded_levels<'a>(
        &self,
        encoder: usize,
        levels: Range<usize>,
        grid: Grid,
        convs: &'a [Vec<FoldedConv>],
    ) -> Vec<BandedLevel<'a>> {
        let modules: &[EncoderLevel] = &self.model.encoders[encoder].levels[levels];
        let mut grid = grid;
        let mut banded = Vec::with_capacity(convs.len());
        for (module, convs) in modules.iter().zip(convs) {
            banded.push(BandedLevel {
                chain: self.chain(convs, grid),
                skip_after: module.skip_after,
            });
            grid = grid.halved();
        }
        banded
    }

    /// The map below a level on `grid`, to be written, if the encoder computes it.
    pub(super) fn pooled_map(
        &self,
        encoder: usize,
        level: usize,
        grid: Grid,
    ) -> Option<FeatureMaps> {
        let module = &self.model.encoders[encoder].levels[level];
        let channels = self.model.config().level_channels()[level];
        module
            .pooled
            .then(|| FeatureMaps::new(grid.halved(), channels))
    }

    pub(super) fn chain<'a>(&self, convs: &'a [FoldedConv], grid: Grid) -> ConvChain<'a> {
        let (isa, tile) = (self.isa, self.tile);
        let banded = convs.iter().map(|conv| {
            let prepared = PreparedConvolution::new(isa, tile, conv.rectified());
            BandedConv::new(prepared, grid)
        });
        let outputs = convs.last().map_or(0, FoldedConv::outputs);
        ConvChain {
            convs: banded.collect(),
            output: RowWindow::new(grid, outputs),
        }
    }

    pub(super) fn skip_fusion(&self, level: usize) -> FoldedConv {
        FoldedConv::conv(&self.model.decoder.levels[LEVELS - 1 - level].fuse, None)
    }
}

pub(super) struct BandedLevel<'a> {
    pub(super) chain: ConvChain<'a>,
    skip_after: usize,
}

pub(super) fn folded_block(block: &ConvBlock) -> FoldedConv {
    FoldedConv::conv(&block.conv, block.norm.as_ref())
}
