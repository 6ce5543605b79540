//! Layers: further channels of the image, such as light groups or alpha. The kernels of a kernel head
//! filter them in the same pass. Other networks denoise each as an image of its own (`layer_images`).
//!
//! A kernel head is linear in the colour for given kernels, K. A layer x becomes `a K(x / a)`, with the
//! albedo `a` of its colour channel as in albedo demodulation, or with `a` = 1. So layers whose sum is
//! the colour still add up to it. Layers are neither clamped nor scaled.

use burn::tensor::{Device, Tensor, TensorData};
use demc_model::config::COLOR_CHANNELS;
use rayon::prelude::*;

use crate::Bundle;
use crate::ensemble::Ensemble;
use crate::error::LayersError;
use crate::padding::{Padding, PixelRange};

/// The last parts of names, in any case, of channels that the albedo's red, green, and blue belong to.
const COLORS: [&str; COLOR_CHANNELS] = ["r", "g", "b"];

/// A channel that is denoised beside the colour.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// The channel's name, such as `ViewLayer.Combined_key.R`.
    pub name: String,
    /// Noisy samples `[H, W]` of either sign.
    pub samples: Vec<f32>,
}

impl Layer {
    /// The colour channel that it belongs to: 0 for a name that ends in `R`, 1 in `G`, 2 in `B`;
    /// `None` for other names, such as `A`.
    pub fn color(&self) -> Option<usize> {
        let last = self.name.rsplit('.').next()?;
        COLORS
            .iter()
            .position(|color| last.eq_ignore_ascii_case(color))
    }

    /// The name without its last part; empty for a name of one part.
    pub(super) fn group(&self) -> &str {
        self.name.rsplit_once('.').map_or("", |(group, _)| group)
    }
}

impl Bundle {
    /// Whether this model can denoise layers with this number of passes.
    ///
    /// # Errors
    /// It is of KPCN, or there are several passes and its head predicts kernels.
    pub fn check_layers(&self, ensemble: Ensemble) -> Result<(), LayersError> {
        if !self.meta.layout.inputs.is_demc() {
            return Err(LayersError::Kpcn);
        }
        match ensemble {
            Ensemble::Four | Ensemble::Eight if self.filters_layers() => {
                Err(LayersError::Ensemble {
                    count: ensemble.count(),
                })
            }
            _ => Ok(()),
        }
    }

    /// Whether the colour's kernels filter layers in the same pass.
    pub(super) fn filters_layers(&self) -> bool {
        self.model.filters_layers()
    }

    /// Number of images of three channels that the kernels filter for this number of layers.
    pub(super) fn filtered_images(&self, layers: usize) -> usize {
        if self.filters_layers() {
            image_count(layers)
        } else {
            0
        }
    }

    /// Number of planes that are in memory for this number of layers, beside a pass.
    pub(super) fn layer_planes(&self, layers: usize) -> usize {
        if layers == 0 {
            0
        } else if self.filters_layers() {
            // The layers of all tiles, and again as a plane each.
            2 * layers
        } else {
            // The results; and an image, its denoised one, and factors.
            layers + 3 * COLOR_CHANNELS
        }
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

/// Number of images of three channels that hold this number of layers.
fn image_count(layers: usize) -> usize {
    layers.div_ceil(COLOR_CHANNELS)
}

/// The layers of a tile, and their factors after the network.
pub(super) struct LayerTile<'a> {
    layers: &'a [Layer],
    /// The factor of albedo demodulation, in gamma space, `[3, rows, columns]`.
    modulation: Option<&'a [f32]>,
    gamma: f32,
    rows: PixelRange,
    columns: PixelRange,
}

impl<'a> LayerTile<'a> {
    pub(super) fn new(
        layers: &'a [Layer],
        modulation: Option<&'a [f32]>,
        gamma: f32,
        [rows, columns]: [&PixelRange; 2],
    ) -> Self {
        LayerTile {
            layers,
            modulation,
            gamma,
            rows: rows.clone(),
            columns: columns.clone(),
        }
    }

    fn pixels(&self) -> usize {
        self.rows.len() * self.columns.len()
    }

    /// The network's input: layers divided by the albedo, and planes of zeros to whole images.
    ///
    /// # Shapes
    /// Returns `[images, 3, rows, columns]`.
    pub(super) fn input(&self, padding: Padding, device: &Device) -> Tensor<4> {
        let images = image_count(self.layers.len());
        let mut planes = Vec::with_capacity(images * COLOR_CHANNELS * self.pixels());
        for layer in self.layers {
            let (rows, columns) = (self.rows.clone(), self.columns.clone());
            planes.extend(padding.cut(&layer.samples, rows, columns));
        }
        self.for_each_albedo(&mut planes, |value, albedo| *value /= albedo);
        planes.resize(images * COLOR_CHANNELS * self.pixels(), 0.0);
        let shape = [images, COLOR_CHANNELS, self.rows.len(), self.columns.len()];
        Tensor::from_data(TensorData::new(planes, shape), device)
    }

    /// The layers of the network's output, multiplied by the albedo.
    ///
    /// # Shapes
    /// `[images, 3, rows, columns]` to `[layers, rows, columns]`.
    pub(super) fn output(&self, mut planes: Vec<f32>) -> Vec<f32> {
        planes.truncate(self.layers.len() * self.pixels());
        self.for_each_albedo(&mut planes, |value, albedo| *value *= albedo);
        planes
    }

    /// Changes each pixel of the layers by its colour's factor of albedo demodulation in linear light.
    fn for_each_albedo(&self, planes: &mut [f32], change: impl Fn(&mut f32, f32) + Sync) {
        let Some(modulation) = self.modulation else {
            return;
        };
        let pixels = self.pixels();
        let planes = planes.par_chunks_mut(pixels).zip(self.layers);
        planes.for_each(|(plane, layer)| {
            let Some(color) = layer.color() else {
                return;
            };
            let factors = &modulation[color * pixels..(color + 1) * pixels];
            for (value, factor) in plane.iter_mut().zip(factors) {
                change(value, factor.powf(self.gamma));
            }
        });
    }
}
