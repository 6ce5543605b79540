//! The input images and their conversion from planes to channels last.

use std::ops::Range;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::tensor::Tensor;
use demc_kernels::Grid;
use rayon::prelude::*;

use super::feature_maps::FeatureMaps;
use crate::config::{DETAIL_CHANNELS, Input, channels_of};

/// The images to denoise: planes of gamma-compressed colour, and of Z-scored features while they
/// are needed.
pub(super) struct InputImages {
    pub(super) grid: Grid,
    color: FlexTensor,
    features: Option<FlexTensor>,
}

/// The contiguous values of a tensor on `flex`.
pub(super) fn host(tensor: Tensor<4>) -> FlexTensor {
    let tensor = tensor
        .try_into_primitive::<Flex>()
        .expect("an image on flex");
    tensor.to_contiguous()
}

impl InputImages {
    /// The images `[B, 3, H, W]` and, for a network that takes them, `[B, 12, H, W]` on `flex`.
    pub(super) fn new(color_gamma: Tensor<4>, features_z: Option<Tensor<4>>) -> Self {
        let [batch, _, height, width] = color_gamma.dims();
        InputImages {
            grid: Grid {
                batch,
                height,
                width,
            },
            color: host(color_gamma),
            features: features_z.map(host),
        }
    }

    /// The planes of the colour, which are shared.
    pub(super) fn color(&self) -> FlexTensor {
        self.color.clone()
    }

    /// The planes that `inputs` contain; frees the others.
    pub(super) fn retain(self, inputs: &[Input]) -> Self {
        let has_features = inputs.contains(&Input::Features);
        InputImages {
            features: self.features.filter(|_| has_features),
            ..self
        }
    }

    /// The concatenation of some inputs, channels last. `detail` is the detail map if one input is.
    pub(super) fn interleaved(&self, parts: &[Input], detail: Option<&FeatureMaps>) -> FeatureMaps {
        let mut all = FeatureMaps::new(self.grid, channels_of(parts));
        for image in 0..self.grid.batch {
            let rows = 0..self.grid.height;
            let detail = detail.map(|detail| detail.rows(image, rows.clone()));
            let target = all.rows_mut(image, rows.clone());
            self.interleave(image, rows, parts, detail, target);
        }
        all
    }

    /// The same for some rows of an image, into `target`; `detail` are these rows of the detail
    /// map.
    pub(super) fn interleave(
        &self,
        image: usize,
        rows: Range<usize>,
        parts: &[Input],
        detail: Option<&[f32]>,
        target: &mut [f32],
    ) {
        let Grid { height, width, .. } = self.grid;
        let channels = channels_of(parts);
        let lines = target.par_chunks_mut(width * channels).enumerate();
        lines.for_each(|(line, target)| {
            let mut offset = 0;
            for part in parts {
                let planes = match part {
                    Input::Color => self.color.storage::<f32>(),
                    Input::Features => {
                        let features = self.features.as_ref();
                        features
                            .expect("features are retained while needed")
                            .storage::<f32>()
                    }
                    Input::DetailMap => {
                        let detail = detail.expect("a variant with a fusion");
                        let detail = &detail[line * width * DETAIL_CHANNELS..];
                        let pixels = detail.chunks_exact(DETAIL_CHANNELS);
                        for (pixel, detail) in target.chunks_exact_mut(channels).zip(pixels) {
                            pixel[offset..offset + DETAIL_CHANNELS].copy_from_slice(detail);
                        }
                        offset += DETAIL_CHANNELS;
                        continue;
                    }
                };
                for channel in 0..part.channels() {
                    let plane = image * part.channels() + channel;
                    let first = (plane * height + rows.start + line) * width;
                    let plane = &planes[first..first + width];
                    for (pixel, value) in target.chunks_exact_mut(channels).zip(plane) {
                        pixel[offset] = *value;
                    }
                    offset += 1;
                }
            }
        });
    }
}
