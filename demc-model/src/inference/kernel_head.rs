//! The kernel head (`crate::kernel_head`) on slices, level by level. Only the logits of a band of
//! rows are in memory.

use std::ops::Range;

use burn::backend::flex::FlexTensor;
use burn::nn::conv::Conv2d;
use burn::tensor::Tensor;
use demc_kernels::blend::{self, Scales};
use demc_kernels::conv1x1::{Epilogue, Part, forward_part};
use demc_kernels::filter::{self, Filter};
use demc_kernels::{Grid, Isa, grid, memory, power};
use rayon::prelude::*;

use super::band::bands;
use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::images::host;
use crate::config::COLOR_CHANNELS;
use crate::kernel_head::{DARKEST, GAMMA, KERNEL_LEVELS};

pub(super) struct KernelHead {
    isa: Isa,
    /// The convolutions to logits, from the full resolution down.
    convs: Vec<FoldedConv>,
    /// The noisy images in linear light, from the full resolution down. After a single image come the
    /// layers that share its kernels.
    scales: Vec<FeatureMaps>,
    /// Number of layers.
    layers: usize,
    /// The output of the levels so far.
    out: Option<FeatureMaps>,
}

/// Images in linear light: planes in gamma space, and the layers `[layers, 3, H, W]` of a single image.
pub(super) fn linear_images(
    isa: Isa,
    grid: Grid,
    color: &FlexTensor,
    layers: Option<Tensor<4>>,
) -> FeatureMaps {
    let count = layers.as_ref().map_or(0, |layers| layers.dims()[0]);
    let all = Grid {
        batch: grid.batch + count,
        ..grid
    };
    let mut images = FeatureMaps::new(all, COLOR_CHANNELS);
    let (colors, others) = images.values.split_at_mut(grid.pixels() * COLOR_CHANNELS);
    grid::nhwc_from_nchw(grid, color.storage::<f32>(), colors);
    power::positive_powers(isa, colors, GAMMA);
    if let Some(layers) = layers.map(host) {
        let grid = Grid {
            batch: count,
            ..grid
        };
        grid::nhwc_from_nchw(grid, layers.storage::<f32>(), others);
    }
    images
}

impl KernelHead {
    /// The kernels that these convolutions, deepest level first, predict for images in linear light. The last
    /// `layers` of them share the kernels of the first.
    pub(super) fn new(isa: Isa, kernels: &[Conv2d], images: FeatureMaps, layers: usize) -> Self {
        let mut scales = vec![images];
        for _ in 1..KERNEL_LEVELS {
            let above = &scales[scales.len() - 1];
            let mut image = FeatureMaps::new(above.grid.halved(), COLOR_CHANNELS);
            blend::halve(above.grid, &above.values, &mut image.values);
            scales.push(image);
        }
        let kernels = kernels.iter().rev();
        KernelHead {
            isa,
            convs: kernels.map(|conv| FoldedConv::conv(conv, None)).collect(),
            scales,
            layers,
            out: None,
        }
    }

    /// The images of a level to be filtered into.
    pub(super) fn filtered(&self, level: usize) -> FeatureMaps {
        let channels = filter::outputs(self.convs[level].outputs());
        FeatureMaps::new(self.scales[level].grid, channels)
    }

    /// Filters some rows of an image and its layers; `decoded` are these rows of the decoder's map.
    pub(super) fn filter_rows(
        &self,
        level: usize,
        image: usize,
        rows: Range<usize>,
        decoded: &[f32],
        filtered: &mut FeatureMaps,
    ) {
        let (conv, scale) = (&self.convs[level], &self.scales[level]);
        let band = scale.band(rows.len());
        let mut logits = memory::buffer(band.pixels() * conv.outputs());
        let part = Part {
            weight: conv.weight(),
            first: 0,
            epilogue: Epilogue {
                bias: Some(conv.bias()),
                relu: false,
                add: false,
            },
        };
        forward_part(self.isa, band, &[decoded], part, &mut logits);
        let images = image..image + 1 + self.layers;
        let x = scale.images(images.clone());
        let grid = Grid {
            batch: images.len(),
            ..scale.grid
        };
        let targets = filtered.rows_of_images_mut(images, rows.clone());
        let filter = Filter { x, logits: &logits };
        filter::forward_rows(self.isa, grid, filter, rows, targets);
    }

    /// Filters a level, if it has kernels, in bands of this many rows; `decoded` is the decoder's map.
    pub(super) fn filter_level(&mut self, level: usize, decoded: &FeatureMaps, band: usize) {
        if level >= KERNEL_LEVELS {
            return;
        }
        let mut filtered = self.filtered(level);
        let Grid { batch, height, .. } = decoded.grid;
        for image in 0..batch {
            for rows in bands(height, band) {
                let decoded = decoded.rows(image, rows.clone());
                self.filter_rows(level, image, rows, decoded, &mut filtered);
            }
        }
        self.blend(filtered);
    }

    /// Completes a level: blends the filtered image with the output so far.
    pub(super) fn blend(&mut self, filtered: FeatureMaps) {
        self.out = Some(match self.out.take() {
            None => filtered,
            Some(coarse) => {
                let mut out = FeatureMaps::new(filtered.grid, COLOR_CHANNELS);
                let scales = Scales {
                    filtered: &filtered.values,
                    coarse: &coarse.values,
                };
                blend::forward(filtered.grid, scales, &mut out.values);
                out
            }
        });
    }

    /// The output in gamma space and the layers in linear light, planar.
    pub(super) fn finish(self) -> (Vec<f32>, Option<Vec<f32>>) {
        let (isa, layers) = (self.isa, self.layers);
        let mut out = self.out.expect("all levels are filtered");
        let batch = out.grid.batch - layers;
        let (colors, others) = {
            let image = out.grid.height * out.grid.width * COLOR_CHANNELS;
            out.values.split_at_mut(batch * image)
        };
        colors.par_iter_mut().for_each(|value| {
            if *value <= DARKEST {
                *value = 0.0;
            }
        });
        power::positive_powers(isa, colors, 1.0 / GAMMA);
        let filtered = (layers > 0).then(|| planar(out.grid, others));
        (planar(out.grid, colors), filtered)
    }
}

/// The planes of images on `grid`, whatever their number.
fn planar(grid: Grid, values: &[f32]) -> Vec<f32> {
    let batch = values.len() / (grid.height * grid.width * COLOR_CHANNELS);
    let mut planar = memory::buffer(values.len());
    grid::nchw_from_nhwc(Grid { batch, ..grid }, values, &mut planar);
    planar
}
