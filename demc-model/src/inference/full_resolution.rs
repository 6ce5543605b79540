//! The full resolution of a large image, band by band. The first pass computes the fusion
//! sub-network and the encoders' upper levels. The last pass recomputes the first level's skips and
//! decodes the image.
//!
//! Maps of the full resolution are the largest of all, and the first level's skips are cheap: two
//! convolutions of few channels each. Recomputing them takes a tenth of the pass's time; keeping
//! them would take a third of its memory. Their sources, mostly three channels each, are kept.

use std::ops::Range;

use demc_kernels::{Grid, memory};

use super::band::{ConvChain, RowWindow, bands};
use super::decoder::folded_level;
use super::encoder::{BandedLevel, folded_block};
use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::images::InputImages;
use super::kernel_head::KernelHead;
use super::pass::InferencePass;
use super::watch::Cancelled;
use crate::config::{COLOR_CHANNELS, DETAIL_CHANNELS, Input};

/// Number of levels that each band passes in one go. Their prepared weights are in memory together;
/// those of a third level would be larger than the maps that it saves.
pub(super) const UPPER_LEVELS: usize = 2;

/// The inputs from which the first level's skips are recomputed.
pub(super) struct SkipSources {
    images: InputImages,
    detail: Option<FeatureMaps>,
}

pub(super) struct UpperLevels {
    /// The skips' share of the second level's fusion.
    pub(super) sum: FeatureMaps,
    pub(super) sources: SkipSources,
    /// The inputs of the level below.
    pub(super) below: Vec<FeatureMaps>,
}

impl InferencePass<'_> {
    fn inputs_by_encoder(&self) -> &'static [&'static [Input]] {
        self.model.config().variant.spec().encoders
    }

    /// Computes the first [`UPPER_LEVELS`] levels of all encoders from the images.
    pub(super) fn encode_upper_levels(
        &self,
        images: InputImages,
    ) -> Result<UpperLevels, Cancelled> {
        let (grid, inputs) = (images.grid, self.inputs_by_encoder());
        let skip_fusion = self.skip_fusion(UPPER_LEVELS - 1);
        let mut sum = FeatureMaps::new(grid.halved(), skip_fusion.outputs());
        let blocks: Vec<FoldedConv> = match &self.model.fusion {
            Some(fusion) => fusion.blocks.iter().map(folded_block).collect(),
            None => Vec::new(),
        };
        let mut fusion = (!blocks.is_empty()).then(|| self.chain(&blocks, grid));
        let mut detail = fusion
            .as_ref()
            .map(|_| FeatureMaps::new(grid, DETAIL_CHANNELS));
        let encoders = 0..inputs.len();
        let convs: Vec<_> = encoders
            .clone()
            .map(|index| self.folded_levels(index, 0..UPPER_LEVELS))
            .collect();
        let mut levels: Vec<Vec<BandedLevel>> = encoders
            .clone()
            .map(|index| self.banded_levels(index, 0..UPPER_LEVELS, grid, &convs[index]))
            .collect();
        let mut below: Vec<Option<FeatureMaps>> = encoders
            .map(|index| self.pooled_map(index, UPPER_LEVELS - 1, sum.grid))
            .collect();

        for image in 0..grid.batch {
            fusion.iter_mut().for_each(ConvChain::restart);
            let all = levels.iter_mut().flatten();
            all.for_each(|level| level.chain.restart());
            for rows in bands(grid.height, self.plan.band) {
                // The second level has a quarter of the pixels.
                self.watch.add(rows.len() * grid.width * 5 / 4)?;
                let mut rows = rows;
                if let (Some(fusion), Some(detail)) = (&mut fusion, &mut detail) {
                    let target = fusion.input().push(rows.len());
                    images.interleave(image, rows, &[Input::Features], None, target);
                    fusion.advance(|_, _, _| ());
                    rows = fusion.output.range();
                    let (_, values) = fusion.output.all();
                    detail.rows_mut(image, rows.clone()).copy_from_slice(values);
                    fusion.output.free_all();
                }
                if rows.is_empty() {
                    continue;
                }
                let detail = detail
                    .as_ref()
                    .map(|detail| detail.rows(image, rows.clone()));
                for (index, levels) in levels.iter_mut().enumerate() {
                    let target = levels[0].chain.input().push(rows.len());
                    images.interleave(image, rows.clone(), inputs[index], detail, target);
                    self.advance(levels, image, below[index].as_mut(), |level, rows, skip| {
                        if level == UPPER_LEVELS - 1 {
                            let band = sum.band(rows.len());
                            let share = sum.rows_mut(image, rows);
                            self.add_skip(index, band, skip, &skip_fusion, share);
                        }
                    });
                }
            }
        }
        let images = images.retain(&inputs.concat());
        Ok(UpperLevels {
            sum,
            sources: SkipSources { images, detail },
            below: below.into_iter().flatten().collect(),
        })
    }

    /// The planar output image, and the layers: the decoder's last level and the head. `below` is the
    /// map of the level below; the first level's skips are recomputed from `sources`.
    pub(super) fn decode_full_resolution(
        &self,
        below: &FeatureMaps,
        sources: SkipSources,
        kernel_head: Option<KernelHead>,
    ) -> Result<(Vec<f32>, Option<Vec<f32>>), Cancelled> {
        let SkipSources { images, detail } = sources;
        let (grid, inputs) = (images.grid, self.inputs_by_encoder());
        let decoder = &self.model.decoder;
        let level = decoder.levels.last().expect("a decoder of LEVELS levels");
        let folded = folded_level(level);
        let prepared = self.prepare_level(level, &folded);
        let [_, skip_fusion] = &folded;
        let conv: Vec<FoldedConv> = decoder.head.iter().map(FoldedConv::head).collect();
        let mut output = match kernel_head {
            Some(head) => OutputRows::Kernels {
                filtered: head.filtered(0),
                decoded: RowWindow::new(grid, skip_fusion.outputs()),
                head,
            },
            None => OutputRows::Convolution {
                chain: self.chain(&conv, grid),
                planar: memory::buffer(grid.pixels() * COLOR_CHANNELS),
            },
        };
        let convs: Vec<Vec<FoldedConv>> = self
            .model
            .encoders
            .iter()
            .map(|encoder| {
                let level = &encoder.levels[0];
                let convs = level.convs[..level.skip_after].iter();
                convs.map(|conv| FoldedConv::conv(conv, None)).collect()
            })
            .collect();
        let mut skips: Vec<ConvChain> = convs.iter().map(|convs| self.chain(convs, grid)).collect();

        for image in 0..grid.batch {
            skips.iter_mut().for_each(ConvChain::restart);
            output.restart();
            for rows in bands(grid.height, self.plan.band) {
                self.watch.add(rows.len() * grid.width)?;
                let detail = detail
                    .as_ref()
                    .map(|detail| detail.rows(image, rows.clone()));
                let mut skip_rows = 0..0;
                for (index, chain) in skips.iter_mut().enumerate() {
                    let target = chain.input().push(rows.len());
                    images.interleave(image, rows.clone(), inputs[index], detail, target);
                    chain.advance(|_, _, _| ());
                    skip_rows = chain.output.range();
                    if skip_rows.is_empty() {
                        continue;
                    }
                    let (band, skip) = chain.output.all();
                    let sum = match index {
                        0 => output.input().push(skip_rows.len()),
                        _ => output.input().last_mut(skip_rows.len()),
                    };
                    self.add_skip(index, band, skip, skip_fusion, sum);
                    chain.output.free_all();
                }
                if skip_rows.is_empty() {
                    continue;
                }
                let sum = output.input().last_mut(skip_rows.len());
                prepared.fuse_rows(below, image, skip_rows, sum);
                output.advance(grid, image);
            }
        }
        Ok(output.finish())
    }
}

/// The head on bands of rows.
enum OutputRows<'a> {
    Convolution {
        chain: ConvChain<'a>,
        planar: Vec<f32>,
    },
    Kernels {
        head: KernelHead,
        decoded: RowWindow,
        filtered: FeatureMaps,
    },
}

impl OutputRows<'_> {
    fn restart(&mut self) {
        match self {
            OutputRows::Convolution { chain, .. } => chain.restart(),
            OutputRows::Kernels { decoded, .. } => decoded.restart(),
        }
    }

    /// The rows of the decoder's map.
    fn input(&mut self) -> &mut RowWindow {
        match self {
            OutputRows::Convolution { chain, .. } => chain.input(),
            OutputRows::Kernels { decoded, .. } => decoded,
        }
    }

    /// Computes all rows of an image that the input allows.
    fn advance(&mut self, grid: Grid, image: usize) {
        match self {
            OutputRows::Convolution { chain, planar } => {
                let values = grid.height * grid.width * COLOR_CHANNELS;
                let planar = &mut planar[image * values..(image + 1) * values];
                chain.advance(|_, rows, colors| write_rows(planar, grid, rows, colors));
                chain.output.free_all();
            }
            OutputRows::Kernels {
                head,
                decoded,
                filtered,
            } => {
                let (_, values) = decoded.all();
                head.filter_rows(0, image, decoded.range(), values, filtered);
                decoded.free_all();
            }
        }
    }

    fn finish(self) -> (Vec<f32>, Option<Vec<f32>>) {
        match self {
            OutputRows::Convolution { planar, .. } => (planar, None),
            OutputRows::Kernels {
                mut head, filtered, ..
            } => {
                head.blend(filtered);
                head.finish()
            }
        }
    }
}

/// Writes rows of an image's colours, channels last, into its planes.
pub(super) fn write_rows(planar: &mut [f32], grid: Grid, rows: Range<usize>, colors: &[f32]) {
    let planes = planar.chunks_exact_mut(grid.height * grid.width);
    for (channel, plane) in planes.enumerate() {
        let plane = &mut plane[rows.start * grid.width..rows.end * grid.width];
        let colors = colors.chunks_exact(COLOR_CHANNELS);
        for (value, color) in plane.iter_mut().zip(colors) {
            *value = color[channel];
        }
    }
}
