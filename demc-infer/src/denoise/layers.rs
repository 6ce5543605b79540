//! Layers: further channels of the image, such as light groups or alpha, that the
//! colour's kernels filter in the same pass.
//!
//! A kernel head is linear in the colour for given kernels, K. A layer x becomes `a K(x / a)`, with the
//! albedo `a` of its colour channel as in albedo demodulation, or with `a` = 1. So layers whose sum is
//! the colour still add up to it. Layers are neither clamped nor scaled.
//!
//! The image of a mixed head, y, is that of its kernels only in part. There a layer becomes
//! `K(x) y / K(c)`, with its channel of the noisy colour c. So layers add up to the image again.

use burn::tensor::{Device, Tensor, TensorData};
use demc_model::Head;
use demc_model::config::COLOR_CHANNELS;
use rayon::prelude::*;

use crate::Bundle;
use crate::ensemble::Ensemble;
use crate::error::LayersError;
use crate::padding::{Padding, PixelRange};

/// The last parts of names, in any case, of channels that the albedo's red, green, and blue belong to.
const COLORS: [&str; COLOR_CHANNELS] = ["r", "g", "b"];

/// A channel that is filtered with the kernels of the colour.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// The channel's name, such as `ViewLayer.Combined_key.R`.
    pub name: String,
    /// Noisy samples `[H, W]` of either sign.
    pub samples: Vec<f32>,
}

impl Layer {
    /// The colour channel whose albedo a model with albedo demodulation divides it by: 0 for a name
    /// that ends in `R`, 1 in `G`, 2 in `B`; `None` for other names, such as `A`.
    pub fn color(&self) -> Option<usize> {
        let last = self.name.rsplit('.').next()?;
        COLORS
            .iter()
            .position(|color| last.eq_ignore_ascii_case(color))
    }
}

impl Bundle {
    /// Whether this model can filter layers with this number of passes.
    ///
    /// # Errors
    /// Its head predicts no kernels, or there are several passes.
    pub fn check_layers(&self, ensemble: Ensemble) -> Result<(), LayersError> {
        let found = self.meta.model.head;
        match (found, ensemble) {
            (Head::Kernel | Head::Mixed, Ensemble::One) => Ok(()),
            (Head::Kernel | Head::Mixed, _) => Err(LayersError::Ensemble {
                count: ensemble.count(),
            }),
            _ => Err(LayersError::Head { found }),
        }
    }

    /// Whether layers are multiplied by the ratio of the image to the filtered colour: with a mixed head.
    pub(super) fn scales_layers(&self) -> bool {
        self.meta.model.head == Head::Mixed
    }

    /// Number of images of three channels that the kernels filter for this number of layers.
    pub(super) fn layer_images(&self, layers: usize) -> usize {
        let has_color = layers > 0 && self.scales_layers();
        (layers + usize::from(has_color) * COLOR_CHANNELS).div_ceil(COLOR_CHANNELS)
    }
}

/// Checks that each layer has this number of pixels.
pub(super) fn check_layer_sizes(layers: &[Layer], expected: usize) -> Result<(), LayersError> {
    let wrong = layers.iter().find(|layer| layer.samples.len() != expected);
    wrong.map_or(Ok(()), |layer| {
        Err(LayersError::Size {
            name: layer.name.clone(),
            found: layer.samples.len(),
            expected,
        })
    })
}

/// The layers of a tile, and their factors after the network.
pub(super) struct LayerTile<'a> {
    layers: &'a [Layer],
    /// The noisy colour `[3, H, W]` for a mixed head, whose image the layers add up to.
    color: Option<&'a [f32]>,
    /// The factor of albedo demodulation, in gamma space, `[3, rows, columns]`.
    modulation: Option<&'a [f32]>,
    gamma: f32,
    rows: PixelRange,
    columns: PixelRange,
}

impl<'a> LayerTile<'a> {
    pub(super) fn new(
        layers: &'a [Layer],
        color: Option<&'a [f32]>,
        modulation: Option<&'a [f32]>,
        gamma: f32,
        [rows, columns]: [&PixelRange; 2],
    ) -> Self {
        LayerTile {
            layers,
            color,
            modulation,
            gamma,
            rows: rows.clone(),
            columns: columns.clone(),
        }
    }

    fn pixels(&self) -> usize {
        self.rows.len() * self.columns.len()
    }

    /// The network's input: layers divided by the albedo, for a mixed head the noisy colour, and planes of
    /// zeros to whole images.
    ///
    /// # Shapes
    /// Returns `[images, 3, rows, columns]`.
    pub(super) fn input(&self, padding: Padding, device: &Device) -> Tensor<4> {
        let samples = self.layers.iter().map(|layer| layer.samples.as_slice());
        let mut planes = Vec::new();
        for samples in samples.chain(self.color) {
            let (rows, columns) = (self.rows.clone(), self.columns.clone());
            planes.extend(padding.cut(samples, rows, columns));
        }
        let images = planes.len().div_ceil(COLOR_CHANNELS * self.pixels());
        self.for_each_factor(&mut planes, self.albedo(), |value, albedo| *value /= albedo);
        planes.resize(images * COLOR_CHANNELS * self.pixels(), 0.0);
        let shape = [images, COLOR_CHANNELS, self.rows.len(), self.columns.len()];
        Tensor::from_data(TensorData::new(planes, shape), device)
    }

    /// The layers of the network's output, multiplied by the albedo, for a mixed head by the ratio of the
    /// image to the filtered colour.
    ///
    /// # Shapes
    /// `[images, 3, rows, columns]` and the denoised image `[3, rows, columns]` to `[layers, rows, columns]`.
    pub(super) fn output(&self, mut planes: Vec<f32>, denoised: &[f32]) -> Vec<f32> {
        let mut others = planes.split_off(self.layers.len() * self.pixels());
        self.for_each_factor(&mut planes, self.albedo(), |value, albedo| *value *= albedo);
        if self.color.is_some() {
            others.truncate(denoised.len());
            let ratios = others.par_iter_mut().zip(denoised);
            ratios.for_each(|(filtered, denoised)| {
                // A tiny filtered value overflows the ratio.
                let ratio = *denoised / *filtered;
                let is_valid = *filtered > 0.0 && ratio.is_finite();
                *filtered = if is_valid { ratio } else { 1.0 };
            });
            self.for_each_factor(&mut planes, Some(others), |value, ratio| *value *= ratio);
        }
        planes
    }

    /// The factor of albedo demodulation in linear light.
    fn albedo(&self) -> Option<Vec<f32>> {
        let modulation = self.modulation?.par_iter();
        Some(modulation.map(|factor| factor.powf(self.gamma)).collect())
    }

    /// Changes each pixel of the layers by its colour's factor, `[3, rows, columns]`.
    fn for_each_factor(
        &self,
        planes: &mut [f32],
        factors: Option<Vec<f32>>,
        change: impl Fn(&mut f32, f32) + Sync,
    ) {
        let Some(factors) = factors else {
            return;
        };
        let pixels = self.pixels();
        let planes = planes.par_chunks_mut(pixels).zip(self.layers);
        planes.for_each(|(plane, layer)| {
            let Some(color) = layer.color() else {
                return;
            };
            let factors = &factors[color * pixels..(color + 1) * pixels];
            for (value, factor) in plane.iter_mut().zip(factors) {
                change(value, *factor);
            }
        });
    }
}
