//! The encoders, all levels: in step from the images, one after another from the maps of the level above.

use std::ops::Range;

use demc_kernels::conv1x1::{self, Finish};
use demc_kernels::conv3x3::Ready;
use demc_kernels::{Grid, pool};
use rayon::prelude::*;

use super::band::{Chain, Stage, Stream};
use super::layer::Layer;
use super::{Images, Maps, Run};
use crate::config::{DETAIL_CHANNELS, Input, LEVELS};
use crate::encoder::EncoderLevel;
use crate::fusion::Fusion;
use crate::layers::ConvBlock;

/// Levels that the rows of the images run through at once. Their weights are ready at the same time; those of a deeper
/// level are larger than the maps that this saves.
pub(super) const LEVELS_IN_STEP: usize = 2;

/// Deepest level that is computed in bands; below it, a map is smaller than the ready weights of its convolutions.
pub(super) const DEEPEST_BANDED: usize = 2;

/// What the encoders leave for the decoder.
pub(super) struct Encoded {
    /// The skips' share of each level's fusion, from the full resolution down.
    pub(super) sums: Vec<Maps>,
    /// The latent's input.
    pub(super) bottom: Maps,
}

impl Run<'_> {
    /// All encoders, all levels.
    pub(super) fn encode(&self, images: Images) -> Encoded {
        let mut sums = Vec::with_capacity(LEVELS);
        let mut inputs = match self.plan.is_banded(images.grid) {
            true => self.descend_in_step(images, &mut sums),
            false => self.inputs(images),
        };
        for level in sums.len()..LEVELS {
            let grid = inputs[0].grid;
            let banded = level <= DEEPEST_BANDED && self.plan.is_banded(grid);
            sums.push(match banded {
                true => self.descend_in_bands(level, &mut inputs),
                false => self.descend(level, &mut inputs),
            });
        }
        let bottom = inputs.pop().expect("the last encoder feeds the latent");
        Encoded { sums, bottom }
    }

    /// What the encoders eat, at once.
    fn inputs(&self, images: Images) -> Vec<Maps> {
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

    fn fusion(&self) -> &Fusion {
        let fusion = self.model.fusion.as_ref();
        fusion.expect("a variant whose encoder eats the detail map has a fusion")
    }

    /// Takes all encoders down a level, whole maps at a time: their inputs become those of the level below. Returns the
    /// skips' share of the level's fusion.
    fn descend(&self, level: usize, inputs: &mut Vec<Maps>) -> Maps {
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
    fn add_skip(&self, encoder: usize, grid: Grid, skip: &[f32], fuse: &Layer, sum: &mut [f32]) {
        let first = (1 + encoder) * fuse.outputs();
        let finish = Finish {
            add: encoder > 0,
            ..Finish::default()
        };
        conv1x1::part(self.isa, grid, &[skip], fuse.weight(), first, finish, sum);
    }

    /// The same in bands, encoder by encoder.
    fn descend_in_bands(&self, level: usize, inputs: &mut Vec<Maps>) -> Maps {
        let grid = inputs[0].grid;
        let fuse = self.fuse(level);
        let mut sum = Maps::new(grid, fuse.outputs());
        let mut below = Vec::with_capacity(inputs.len());
        for (index, input) in std::mem::take(inputs).into_iter().enumerate() {
            let layers = self.layers(index, level..level + 1);
            let mut levels = self.levels(index, level..level + 1, grid, &layers);
            let mut pooled = self.below(index, level, grid);
            let fuses = std::slice::from_ref(&fuse);
            for image in 0..grid.batch {
                levels.iter_mut().for_each(|level| level.chain.restart());
                let mut to = 0;
                for rows in bands(grid.height, self.plan.band_rows(grid)) {
                    let push = levels[0].chain.input().push(rows.len());
                    push.copy_from_slice(input.rows(image, rows));
                    let sums = std::slice::from_mut(&mut sum);
                    self.flow(
                        &mut levels,
                        fuses,
                        sums,
                        index,
                        image,
                        pooled.as_mut(),
                        &mut to,
                    );
                }
            }
            below.extend(pooled);
        }
        *inputs = below;
        sum
    }

    /// Takes all encoders from the images down [`LEVELS_IN_STEP`] levels, band by band. Adds the skips' shares of the
    /// fusions to `sums` and returns the inputs of the level below.
    fn descend_in_step(&self, images: Images, sums: &mut Vec<Maps>) -> Vec<Maps> {
        let (grid, band) = (images.grid, self.plan.band_rows(images.grid));
        let inputs = self.model.config().variant.spec().encoders;
        let fuses: Vec<Layer> = (0..LEVELS_IN_STEP).map(|level| self.fuse(level)).collect();
        let mut size = grid;
        for fuse in &fuses {
            sums.push(Maps::new(size, fuse.outputs()));
            size = size.halved();
        }
        let blocks: Vec<Layer> = match &self.model.fusion {
            Some(fusion) => fusion.blocks.iter().map(block_layer).collect(),
            None => Vec::new(),
        };
        let mut fusion = (!blocks.is_empty()).then(|| self.chain(&blocks, grid));
        let layers: Vec<_> = (0..inputs.len())
            .map(|index| self.layers(index, 0..LEVELS_IN_STEP))
            .collect();
        let mut encoders: Vec<Vec<Level>> = layers
            .iter()
            .enumerate()
            .map(|(index, layers)| self.levels(index, 0..LEVELS_IN_STEP, grid, layers))
            .collect();
        let mut below: Vec<Option<Maps>> = (0..inputs.len())
            .map(|index| self.below(index, LEVELS_IN_STEP - 1, sums[LEVELS_IN_STEP - 1].grid))
            .collect();

        for image in 0..grid.batch {
            fusion.iter_mut().for_each(Chain::restart);
            encoders
                .iter_mut()
                .flatten()
                .for_each(|level| level.chain.restart());
            let mut to = vec![0; inputs.len()];
            for rows in bands(grid.height, band) {
                let mut rows = rows;
                if let Some(fusion) = &mut fusion {
                    let push = fusion.input().push(rows.len());
                    images.interleave(image, rows, &[Input::Features], None, push);
                    fusion.output.forget();
                    fusion.advance(|_, _, _| ());
                    rows = fusion.output.range();
                }
                let detail = fusion.as_ref().map(|fusion| fusion.output.all().1);
                for (index, levels) in encoders.iter_mut().enumerate() {
                    if rows.is_empty() {
                        continue;
                    }
                    let push = levels[0].chain.input().push(rows.len());
                    images.interleave(image, rows.clone(), inputs[index], detail, push);
                    let below = below[index].as_mut();
                    self.flow(levels, &fuses, sums, index, image, below, &mut to[index]);
                }
            }
        }
        below.into_iter().flatten().collect()
    }

    /// Lets the rows that have come into the first of `levels` flow through all of them: skips into `sums`, the pooled
    /// rows of the last level into `below` from row `to` on.
    #[allow(clippy::too_many_arguments, reason = "where rows come from and go to")]
    fn flow(
        &self,
        levels: &mut [Level],
        fuses: &[Layer],
        sums: &mut [Maps],
        encoder: usize,
        image: usize,
        mut below: Option<&mut Maps>,
        to: &mut usize,
    ) {
        for index in 0..levels.len() {
            let (upper, lower) = levels.split_at_mut(index + 1);
            let Level { chain, skip_after } = &mut upper[index];
            let (fuse, sum) = (&fuses[index], &mut sums[index]);
            chain.advance(|stage, rows, values| {
                if stage + 1 == *skip_after {
                    let grid = sum.band(rows.len());
                    self.add_skip(encoder, grid, values, fuse, sum.rows_mut(image, rows));
                }
            });
            let (grid, made) = chain.output.all();
            let rows = grid.height / 2;
            if rows > 0 {
                let pooled = match (lower.first_mut(), &mut below) {
                    (Some(level), _) => level.chain.input().push(rows),
                    (None, Some(below)) => below.rows_mut(image, *to..*to + rows),
                    // An encoder that does not feed the latent ends with its last skip.
                    (None, None) => &mut [],
                };
                if !pooled.is_empty() {
                    pool::forward(self.isa, grid, made, pooled);
                }
                if lower.is_empty() {
                    *to += rows;
                }
            }
            chain.output.forget();
        }
    }

    /// The convolutions of some levels of an encoder.
    fn layers(&self, encoder: usize, levels: Range<usize>) -> Vec<Vec<Layer>> {
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
    fn levels<'a>(
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
    fn below(&self, encoder: usize, level: usize, grid: Grid) -> Option<Maps> {
        let spec = &self.model.encoders[encoder].levels[level];
        let channels = self.model.config().level_channels()[level];
        spec.pooled.then(|| Maps::new(grid.halved(), channels))
    }

    /// The convolutions of these layers for bands of an image on `grid`, each with its ReLU.
    fn chain<'a>(&self, layers: &'a [Layer], grid: Grid) -> Chain<'a> {
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
    fn fuse(&self, level: usize) -> Layer {
        Layer::conv(&self.model.decoder.levels[LEVELS - 1 - level].fuse, None)
    }
}

/// A level of an encoder in bands.
struct Level<'a> {
    chain: Chain<'a>,
    /// After how many of its convolutions the skip is taken.
    skip_after: usize,
}

fn block_layer(block: &ConvBlock) -> Layer {
    Layer::conv(&block.conv, block.norm.as_ref())
}

/// The bands of `height` rows, `band` each but the last.
pub(super) fn bands(height: usize, band: usize) -> impl Iterator<Item = Range<usize>> {
    let starts = (0..height).step_by(band);
    starts.map(move |start| start..(start + band).min(height))
}

impl Images {
    /// Some inputs of a batch side by side, channels last; `detail` is the detail map where one of them is it.
    fn interleaved(&self, parts: &[Input], detail: Option<&Maps>) -> Maps {
        let channels = parts.iter().map(|part| part.channels()).sum();
        let mut all = Maps::new(self.grid, channels);
        for image in 0..self.grid.batch {
            let rows = 0..self.grid.height;
            let detail = detail.map(|detail| detail.rows(image, rows.clone()));
            let to = all.rows_mut(image, rows.clone());
            self.interleave(image, rows, parts, detail, to);
        }
        all
    }

    /// The same of some rows of an image; `detail` are those rows of the detail map.
    fn interleave(
        &self,
        image: usize,
        rows: Range<usize>,
        parts: &[Input],
        detail: Option<&[f32]>,
        to: &mut [f32],
    ) {
        let Grid { height, width, .. } = self.grid;
        let channels: usize = parts.iter().map(|part| part.channels()).sum();
        let lines = to.par_chunks_mut(width * channels).enumerate();
        lines.for_each(|(line, to)| {
            let mut at = 0;
            for part in parts {
                let planes = match part {
                    Input::Color => self.color(),
                    Input::Features => self.features(),
                    Input::DetailMap => {
                        let detail = detail.expect("a variant with a fusion");
                        let detail = &detail[line * width * DETAIL_CHANNELS..];
                        let pixels = detail.chunks_exact(DETAIL_CHANNELS);
                        for (to, from) in to.chunks_exact_mut(channels).zip(pixels) {
                            to[at..at + DETAIL_CHANNELS].copy_from_slice(from);
                        }
                        at += DETAIL_CHANNELS;
                        continue;
                    }
                };
                for channel in 0..part.channels() {
                    let plane = image * part.channels() + channel;
                    let first = (plane * height + rows.start + line) * width;
                    let plane = &planes[first..first + width];
                    for (to, from) in to.chunks_exact_mut(channels).zip(plane) {
                        to[at] = *from;
                    }
                    at += 1;
                }
            }
        });
    }
}
