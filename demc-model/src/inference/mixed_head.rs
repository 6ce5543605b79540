//! The mixed head (`crate::mixed_head`) on slices. The gate's logits are whole, one for each pixel.

use std::ops::Range;

use burn::backend::flex::FlexTensor;
use burn::tensor::Tensor;
use demc_kernels::conv1x1::{Epilogue, Part, forward_part};
use demc_kernels::{Grid, Isa, pu};
use rayon::prelude::*;

use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::kernel_head::{KernelHead, linear_images, planar};
use crate::config::COLOR_CHANNELS;
use crate::mixed_head::MixedHead;
use crate::pu::BRIGHTEST;

pub(super) struct MixedPass {
    isa: Isa,
    kernels: KernelHead,
    /// The images of the full resolution, filtered row by row.
    filtered: FeatureMaps,
    gate: FoldedConv,
    logits: FeatureMaps,
}

impl MixedPass {
    /// The head for planes in the network's space, and layers `[layers, 3, H, W]` of a single image.
    pub(super) fn new(
        isa: Isa,
        head: &MixedHead,
        grid: Grid,
        color: &FlexTensor,
        layers: Option<Tensor<4>>,
    ) -> Self {
        let images = linear_images(grid, color, layers, |colors| {
            let peak = pu::value(pu::PEAK);
            colors.par_iter_mut().for_each(|value| {
                *value = pu::inverse((*value * peak).clamp(0.0, BRIGHTEST * peak));
            });
        });
        let layers = images.grid.batch - grid.batch;
        let kernels = KernelHead::new(isa, &head.kernels, images, layers);
        MixedPass {
            isa,
            filtered: kernels.filtered(0),
            kernels,
            gate: FoldedConv::conv(&head.gate, None),
            logits: FeatureMaps::new(grid, 1),
        }
    }

    /// Filters a level below the full resolution, in bands; `decoded` is the decoder's map.
    pub(super) fn filter_level(&mut self, level: usize, decoded: &FeatureMaps, band: usize) {
        self.kernels.filter_level(level, decoded, band);
    }

    /// Filters rows of the full resolution; `decoded` are these rows of the decoder's map.
    pub(super) fn filter_rows(&mut self, image: usize, rows: Range<usize>, decoded: &[f32]) {
        let part = Part {
            weight: self.gate.weight(),
            first: 0,
            epilogue: Epilogue {
                bias: Some(self.gate.bias()),
                ..Epilogue::default()
            },
        };
        let band = self.logits.band(rows.len());
        let logits = self.logits.rows_mut(image, rows.clone());
        forward_part(self.isa, band, &[decoded], part, logits);
        self.kernels
            .filter_rows(0, image, rows, decoded, &mut self.filtered);
    }

    /// Blends the filtered image into the planes of the direct one. Returns the planes of the layers, if any.
    pub(super) fn blend(mut self, direct: &mut [f32]) -> Option<Vec<f32>> {
        self.kernels.blend(self.filtered);
        let filtered = self.kernels.into_images();
        let Grid { height, width, .. } = filtered.grid;
        let lines = direct.par_chunks_mut(width).enumerate();
        lines.for_each(|(line, direct)| {
            let (plane, row) = (line / height, line % height);
            let (image, channel) = (plane / COLOR_CHANNELS, plane % COLOR_CHANNELS);
            let logits = self.logits.rows(image, row..row + 1);
            let colors = filtered
                .rows(image, row..row + 1)
                .chunks_exact(COLOR_CHANNELS);
            for ((value, logit), color) in direct.iter_mut().zip(logits).zip(colors) {
                let color = pu::value(color[channel].max(0.0)) / pu::value(pu::PEAK);
                *value += (color - *value) / (1.0 + (-logit).exp());
            }
        });
        let layers = &filtered.values[direct.len()..];
        (!layers.is_empty()).then(|| planar(filtered.grid, layers))
    }
}
