//! The full resolution, band by band: the fusion sub-network and the encoders' upper levels in step on the way down, and
//! the first level's skips once more, with the decoder, on the way up.
//!
//! At the full resolution a map of the base width is the largest thing there is, and the first level's skips are cheap:
//! two convolutions of few channels each. Computing them again takes a tenth of the pass's time; keeping them would take a
//! third of its memory. What they are computed from, three channels a piece, is kept.

use std::ops::Range;

use demc_kernels::{Grid, memory};

use super::band::{Chain, bands};
use super::decoder::level_layers;
use super::encoder::{Level, block_layer};
use super::images::Images;
use super::layer::Layer;
use super::{Maps, Run};
use crate::config::{COLOR_CHANNELS, DETAIL_CHANNELS, Input};

/// Levels that the rows of the images run through at once. Their weights are ready at the same time; those of a deeper
/// level are larger than the maps that this saves.
pub(super) const LEVELS_IN_STEP: usize = 2;

/// What the first level's skips can be computed from once more.
pub(super) struct Again {
    images: Images,
    detail: Option<Maps>,
}

/// The encoders' levels in step.
pub(super) struct Step {
    /// The skips' share of the second level's fusion.
    pub(super) sum: Maps,
    pub(super) again: Again,
    /// The inputs of the level below.
    pub(super) below: Vec<Maps>,
}

impl Run<'_> {
    fn inputs_of_encoders(&self) -> &'static [&'static [Input]] {
        self.model.config().variant.spec().encoders
    }

    /// Takes all encoders from the images down [`LEVELS_IN_STEP`] levels.
    pub(super) fn descend_in_step(&self, images: Images) -> Step {
        let (grid, inputs) = (images.grid, self.inputs_of_encoders());
        let fuse = self.fuse(LEVELS_IN_STEP - 1);
        let mut sum = Maps::new(grid.halved(), fuse.outputs());
        let blocks: Vec<Layer> = match &self.model.fusion {
            Some(fusion) => fusion.blocks.iter().map(block_layer).collect(),
            None => Vec::new(),
        };
        let mut fusion = (!blocks.is_empty()).then(|| self.chain(&blocks, grid));
        let mut detail = fusion.as_ref().map(|_| Maps::new(grid, DETAIL_CHANNELS));
        let encoders = 0..inputs.len();
        let layers: Vec<_> = encoders
            .clone()
            .map(|index| self.layers(index, 0..LEVELS_IN_STEP))
            .collect();
        let mut levels: Vec<Vec<Level>> = encoders
            .clone()
            .map(|index| self.levels(index, 0..LEVELS_IN_STEP, grid, &layers[index]))
            .collect();
        let mut below: Vec<Option<Maps>> = encoders
            .map(|index| self.below(index, LEVELS_IN_STEP - 1, sum.grid))
            .collect();

        for image in 0..grid.batch {
            fusion.iter_mut().for_each(Chain::restart);
            let all = levels.iter_mut().flatten();
            all.for_each(|level| level.chain.restart());
            for rows in bands(grid.height, self.plan.band) {
                let mut rows = rows;
                if let (Some(fusion), Some(detail)) = (&mut fusion, &mut detail) {
                    let push = fusion.input().push(rows.len());
                    images.interleave(image, rows, &[Input::Features], None, push);
                    fusion.advance(|_, _, _| ());
                    rows = fusion.output.range();
                    let made = fusion.output.all().1;
                    detail.rows_mut(image, rows.clone()).copy_from_slice(made);
                    fusion.output.forget();
                }
                if rows.is_empty() {
                    continue;
                }
                let detail = detail
                    .as_ref()
                    .map(|detail| detail.rows(image, rows.clone()));
                for (index, levels) in levels.iter_mut().enumerate() {
                    let push = levels[0].chain.input().push(rows.len());
                    images.interleave(image, rows.clone(), inputs[index], detail, push);
                    self.flow(levels, image, below[index].as_mut(), |level, rows, skip| {
                        if level == LEVELS_IN_STEP - 1 {
                            let band = sum.band(rows.len());
                            self.add_skip(index, band, skip, &fuse, sum.rows_mut(image, rows));
                        }
                    });
                }
            }
        }
        let images = images.keep(&inputs.concat());
        Step {
            sum,
            again: Again { images, detail },
            below: below.into_iter().flatten().collect(),
        }
    }

    /// The decoder's last level and the output convolution, planar: from the map below, and the first level's skips once
    /// more.
    pub(super) fn finish_in_step(&self, below: &Maps, again: Again) -> Vec<f32> {
        let Again { images, detail } = again;
        let (grid, inputs) = (images.grid, self.inputs_of_encoders());
        let decoder = &self.model.decoder;
        let level = decoder.levels.last().expect("a decoder of LEVELS levels");
        let fusion = level_layers(level);
        let ascent = self.ascent(level, &fusion);
        let [_, fuse] = &fusion;
        let head = [Layer::conv(&decoder.head, None)];
        let mut head = self.chain(&head, grid);
        let layers: Vec<Vec<Layer>> = self
            .model
            .encoders
            .iter()
            .map(|encoder| {
                let level = &encoder.levels[0];
                let convs = level.convs[..level.skip_after].iter();
                convs.map(|conv| Layer::conv(conv, None)).collect()
            })
            .collect();
        let mut skips: Vec<Chain> = layers
            .iter()
            .map(|layers| self.chain(layers, grid))
            .collect();

        let plane = grid.height * grid.width;
        let mut planar = memory::buffer(grid.pixels() * COLOR_CHANNELS);
        for (image, planar) in planar.chunks_exact_mut(plane * COLOR_CHANNELS).enumerate() {
            skips.iter_mut().chain([&mut head]).for_each(Chain::restart);
            for rows in bands(grid.height, self.plan.band) {
                let detail = detail
                    .as_ref()
                    .map(|detail| detail.rows(image, rows.clone()));
                let mut made = 0..0;
                for (index, chain) in skips.iter_mut().enumerate() {
                    let push = chain.input().push(rows.len());
                    images.interleave(image, rows.clone(), inputs[index], detail, push);
                    chain.advance(|_, _, _| ());
                    made = chain.output.range();
                    if made.is_empty() {
                        continue;
                    }
                    let (band, skip) = chain.output.all();
                    let sum = match index {
                        0 => head.input().push(made.len()),
                        _ => head.input().last_mut(made.len()),
                    };
                    self.add_skip(index, band, skip, fuse, sum);
                    chain.output.forget();
                }
                if made.is_empty() {
                    continue;
                }
                let sum = head.input().last_mut(made.len());
                ascent.finish_rows(below, image, made, sum);
                head.advance(|_, rows, colors| put_rows(planar, grid, rows, colors));
                head.output.forget();
            }
        }
        planar
    }
}

/// Puts rows of an image's colours, channels last, to their places in its planes.
fn put_rows(planar: &mut [f32], grid: Grid, rows: Range<usize>, colors: &[f32]) {
    let planes = planar.chunks_exact_mut(grid.height * grid.width);
    for (channel, plane) in planes.enumerate() {
        let plane = &mut plane[rows.start * grid.width..rows.end * grid.width];
        let colors = colors.chunks_exact(COLOR_CHANNELS);
        for (to, color) in plane.iter_mut().zip(colors) {
            *to = color[channel];
        }
    }
}
