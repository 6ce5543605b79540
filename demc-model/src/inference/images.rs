//! The images that come in, and the way from planes to channels last.

use std::ops::Range;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::tensor::Tensor;
use demc_kernels::Grid;
use rayon::prelude::*;

use super::Maps;
use crate::config::{DETAIL_CHANNELS, Input};

/// What is to be denoised: planes of gamma-compressed colour, and of Z-scored features as long as they are needed.
pub(super) struct Images {
    pub(super) grid: Grid,
    color: FlexTensor,
    features: Option<FlexTensor>,
}

fn host(tensor: Tensor<4>) -> FlexTensor {
    let tensor = tensor
        .try_into_primitive::<Flex>()
        .expect("an image on flex");
    tensor.to_contiguous()
}

impl Images {
    /// Of `[B, 3, H, W]` and `[B, 12, H, W]` on `flex`.
    pub(super) fn new(color_gamma: Tensor<4>, features_z: Tensor<4>) -> Self {
        let [batch, _, height, width] = color_gamma.dims();
        Images {
            grid: Grid {
                batch,
                height,
                width,
            },
            color: host(color_gamma),
            features: Some(host(features_z)),
        }
    }

    /// Those of its planes that make one of these inputs.
    pub(super) fn keep(self, inputs: &[Input]) -> Self {
        let keeps = inputs.contains(&Input::Features);
        Images {
            features: self.features.filter(|_| keeps),
            ..self
        }
    }

    /// Some inputs of a batch side by side, channels last; `detail` is the detail map where one of them is it.
    pub(super) fn interleaved(&self, parts: &[Input], detail: Option<&Maps>) -> Maps {
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
    pub(super) fn interleave(
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
                    Input::Color => self.color.storage::<f32>(),
                    Input::Features => {
                        let features = self.features.as_ref();
                        features.expect("kept where needed").storage::<f32>()
                    }
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
