//! The encoders, level by level: whole maps, or bands of them.

use std::ops::Range;

use demc_kernels::conv1x1::{self, Finish};
use demc_kernels::conv3x3::Ready;
use demc_kernels::{Grid, pool};

use super::band::{Chain, Stage, Stream, bands};
use super::images::Images;
use super::layer::Layer;
use super::{Maps, Run};
use crate::config::{Input, LEVELS};
use crate::encoder::EncoderLevel;
use crate::fusion::Fusion;
use crate::layers::ConvBlock;

/// Deepest level that is computed in bands; below it, a map is smaller than the ready weights of its convolutions.
pub(super) const DEEPEST_BANDED: usize = 2;

impl Run<'_> {
    /// What the encoders eat, at once.
    pub(super) fn inputs(&self, images: Images) -> Vec<Maps> {
        let spec = self.model.config().variant.spec();
        let detail = spec.has_fusion().then(|| {
            let features = images.interleaved(&[Input::Features], None);
            let blocks = self.fusion().blocks.iter();
            blocks.fold(features, |x, block| self.conv3x3(&x, &block_layer(block)))
        });
        let parts = spec.encoders.iter();
        parts
            .map(|parts| images.interleaved(parts, detail.as_ref()))
            .collect()
    }

    pub(super) fn fusion(&self) -> &Fusion {
        let fusion = self.model.fusion.as_ref();
        fusion.expect("a variant whose encoder eats the detail map has a fusion")
    }

    /// Takes all encoders down a level, whole maps at a time: their inputs become those of the level below. Returns the
    /// skips' share of the level's fusion.
    pub(super) fn descend(&self, level: usize, inputs: &mut Vec<Maps>) -> Maps {
        let grid = inputs[0].grid;
        let fuse = self.fuse(level);
        let mut sum = Maps::new(grid, fuse.outputs());
        for (index, input) in std::mem::take(inputs).into_iter().enumerate() {
            let level = &self.model.encoders[index].levels[level];
            let mut x = input;
            for (made, conv) in level.convs.iter().enumerate() {
                x = self.conv3x3(&x, &Layer::conv(conv, None));
                if made + 1 == level.skip_after {
                    self.add_skip(index, grid, &x.values, &fuse, &mut sum.values);
                }
            }
            if level.pooled {
                let mut below = Maps::new(grid.halved(), x.channels());
                pool::forward(self.isa, grid, &x.values, &mut below.values);
                inputs.push(below);
            }
        }
        sum
    }

    /// Adds an encoder's skip, times its part of a fusion, to what those before it gave.
    pub(super) fn add_skip(
        &self,
        encoder: usize,
        grid: Grid,
        skip: &[f32],
        fuse: &Layer,
        sum: &mut [f32],
    ) {
        let first = (1 + encoder) * fuse.outputs();
        let finish = Finish {
            add: encoder > 0,
            ..Finish::default()
        };
        conv1x1::part(self.isa, grid, &[skip], fuse.weight(), first, finish, sum);
    }

    /// The same in bands, encoder by encoder.
    pub(super) fn descend_in_bands(&self, level: usize, inputs: &mut Vec<Maps>) -> Maps {
        let grid = inputs[0].grid;
        let fuse = self.fuse(level);
        let mut sum = Maps::new(grid, fuse.outputs());
        let mut below = Vec::with_capacity(inputs.len());
        for (index, input) in std::mem::take(inputs).into_iter().enumerate() {
            let layers = self.layers(index, level..level + 1);
            let mut levels = self.levels(index, level..level + 1, grid, &layers);
            let mut pooled = self.below(index, level, grid);
            for image in 0..grid.batch {
                levels.iter_mut().for_each(|level| level.chain.restart());
                for rows in bands(grid.height, self.plan.band) {
                    let push = levels[0].chain.input().push(rows.len());
                    push.copy_from_slice(input.rows(image, rows));
                    self.flow(&mut levels, image, pooled.as_mut(), |_, rows, skip| {
                        let band = sum.band(rows.len());
                        self.add_skip(index, band, skip, &fuse, sum.rows_mut(image, rows));
                    });
                }
            }
            below.extend(pooled);
        }
        *inputs = below;
        sum
    }

    /// Lets the rows that have come into the first of `levels` flow through all of them: the pooled rows of the last one
    /// into `below`, each level's skip to `see`, with the level's index and the rows.
    pub(super) fn flow(
        &self,
        levels: &mut [Level],
        image: usize,
        mut below: Option<&mut Maps>,
        mut see: impl FnMut(usize, Range<usize>, &[f32]),
    ) {
        for index in 0..levels.len() {
            let (upper, lower) = levels.split_at_mut(index + 1);
            let Level { chain, skip_after } = &mut upper[index];
            chain.advance(|stage, rows, values| {
                if stage + 1 == *skip_after {
                    see(index, rows, values);
                }
            });
            let (grid, made) = chain.output.all();
            let range = chain.output.range();
            let pooled = match (lower.first_mut(), &mut below) {
                _ if range.is_empty() => None,
                (Some(level), _) => Some(level.chain.input().push(range.len() / 2)),
                (None, Some(below)) => Some(below.rows_mut(image, range.start / 2..range.end / 2)),
                // An encoder that does not feed the latent ends with its last skip.
                (None, None) => None,
            };
            if let Some(pooled) = pooled {
                pool::forward(self.isa, grid, made, pooled);
            }
            chain.output.forget();
        }
    }

    /// The convolutions of some levels of an encoder.
    pub(super) fn layers(&self, encoder: usize, levels: Range<usize>) -> Vec<Vec<Layer>> {
        let levels = &self.model.encoders[encoder].levels[levels];
        levels
            .iter()
            .map(|level| {
                let convs = level.convs.iter();
                convs.map(|conv| Layer::conv(conv, None)).collect()
            })
            .collect()
    }

    /// Some levels of an encoder, ready for bands of a first level's `grid`.
    pub(super) fn levels<'a>(
        &self,
        encoder: usize,
        levels: Range<usize>,
        grid: Grid,
        layers: &'a [Vec<Layer>],
    ) -> Vec<Level<'a>> {
        let specs: &[EncoderLevel] = &self.model.encoders[encoder].levels[levels];
        let mut grid = grid;
        let mut ready = Vec::with_capacity(layers.len());
        for (spec, layers) in specs.iter().zip(layers) {
            ready.push(Level {
                chain: self.chain(layers, grid),
                skip_after: spec.skip_after,
            });
            grid = grid.halved();
        }
        ready
    }

    /// The pooled map below a level, where the encoder computes it.
    pub(super) fn below(&self, encoder: usize, level: usize, grid: Grid) -> Option<Maps> {
        let spec = &self.model.encoders[encoder].levels[level];
        let channels = self.model.config().level_channels()[level];
        spec.pooled.then(|| Maps::new(grid.halved(), channels))
    }

    /// The convolutions of these layers for bands of an image on `grid`, each with its ReLU.
    pub(super) fn chain<'a>(&self, layers: &'a [Layer], grid: Grid) -> Chain<'a> {
        let stages: Vec<Stage> = layers
            .iter()
            .map(|layer| {
                let conv = Ready::new(self.isa, self.tile, layer.weight(), layer.bias(), true);
                let inputs = conv.inputs();
                Stage::new(conv, Stream::new(grid, inputs))
            })
            .collect();
        let outputs = layers.last().map_or(0, Layer::outputs);
        Chain {
            stages,
            output: Stream::new(grid, outputs),
        }
    }

    /// The skip fusion of a level, counted from the full resolution down.
    pub(super) fn fuse(&self, level: usize) -> Layer {
        Layer::conv(&self.model.decoder.levels[LEVELS - 1 - level].fuse, None)
    }
}

/// A level of an encoder in bands.
pub(super) struct Level<'a> {
    pub(super) chain: Chain<'a>,
    /// After how many of its convolutions the skip is taken.
    skip_after: usize,
}

pub(super) fn block_layer(block: &ConvBlock) -> Layer {
    Layer::conv(&block.conv, block.norm.as_ref())
}
