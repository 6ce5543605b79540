//! Denoises a frame: exposure and positions, padding and tiles, gamma, albedo demodulation and
//! Z-score, the network, and back to linear HDR.

mod albedo;
#[cfg(test)]
mod filter_tests;
mod input;
#[cfg(test)]
mod kpcn_tests;
mod layer_images;
mod layers;
#[cfg(test)]
mod layers_tests;
mod light;
mod progress;
mod seams;
#[cfg(test)]
mod tests;

use std::ops::ControlFlow;

use burn::module::Module;
use burn::tensor::Device;
use demc_data::input::kpcn::PASS_PLANES;
use demc_data::input::transform::exposure_scale;
use demc_data::{FEATURES, Frame, InputKind, Ranges};
use demc_model::config::{COLOR_CHANNELS, DETAIL_CHANNELS, DOWNSAMPLING};

use crate::ensemble::Ensemble;
use crate::padding::Padding;
use crate::tiles::{Tiles, Tiling};
use crate::{Bundle, memory};
use input::FrameInput;
use layer_images::LayerImages;
use layers::check_layer_sizes;
use progress::of_pass;

pub use crate::error::{DenoiseError, LayersError};
pub use demc_data::input::transform::MAX_INPUT_SCALE;
pub use layers::Layer;
pub use progress::{DenoiseObserver, DenoiseProgress, unobserved};
pub use seams::SeamError;

/// Exposures up to this factor outside the training scenes' range are not scaled: a stop, the
/// exposure augmentation of training. On the data set's scenes, a stop within the range changed the
/// error by up to 25 % in either direction.
const TOLERANCE: f64 = 2.0;

/// Side of the tiles of a detail map in pixels: with 64 maps, 0.5 GB.
const DETAIL_TILE: usize = 1024;

/// How a frame is denoised.
#[derive(Debug, Clone, Default)]
pub struct DenoiseOptions {
    /// Tiles of a large image.
    pub tiling: Tiling,
    /// Test-time augmentation.
    pub ensemble: Ensemble,
    /// Factor on the colour before the network; the output is divided by it. `None`: the image's
    /// own [`Bundle::input_scale`].
    pub input_scale: Option<f32>,
    /// Whether the output gets the light of the noisy image. `None`: as the model says.
    pub restore_light: Option<bool>,
    /// Further channels to denoise; see [`Bundle::check_layers`]. Those of a network without kernels
    /// have their own exposures.
    pub layers: Vec<Layer>,
}

/// A denoised image, and how it was made.
#[derive(Debug, Clone, PartialEq)]
pub struct Denoised {
    /// Planar `[3, H, W]`, linear HDR, not negative.
    pub color_hdr: Vec<f32>,
    /// The denoised alpha `[H, W]`, for a frame whose alpha varies.
    pub alpha: Option<Vec<f32>>,
    /// The denoised layers `[layers, H, W]`, in the order of the options. Of either sign with a kernel
    /// head.
    pub layers: Vec<f32>,
    /// The tiles that the image was cut into.
    pub tiles: Tiles,
    /// The error of a halo below the exact one, measured at seams; `None` for exact tiles or a
    /// single tile.
    pub seam_error: Option<SeamError>,
}

impl Bundle {
    /// Denoises `frame`, of any size that a file can have ([`demc_data::image::exr::check_size`]).
    ///
    /// The image is processed whole if memory allows, otherwise in tiles with the same result
    /// ([`crate::tiles`]). It is padded by edge replication to multiples of 32 and cropped
    /// afterwards.
    ///
    /// # Shapes
    /// Returns planar `[3, H, W]` in linear HDR, not negative.
    ///
    /// # Errors
    /// As [`check_statistics`](Self::check_statistics). Further: the smallest tile does not fit
    /// into the available memory, the device fails, or the output is not finite.
    pub fn denoise(&self, frame: &Frame) -> Result<Vec<f32>, DenoiseError> {
        self.denoise_with(frame, &DenoiseOptions::default(), unobserved)
            .map(|denoised| denoised.color_hdr)
    }

    /// As [`denoise`](Self::denoise), with options.
    ///
    /// `observer` receives the progress, and may stop the work.
    ///
    /// # Errors
    /// As [`denoise`](Self::denoise), and [`DenoiseError::Cancelled`].
    pub fn denoise_with(
        &self,
        frame: &Frame,
        options: &DenoiseOptions,
        mut observer: impl FnMut(DenoiseProgress) -> ControlFlow<()>,
    ) -> Result<Denoised, DenoiseError> {
        let DenoiseOptions {
            tiling,
            ensemble,
            input_scale,
            restore_light,
            layers,
        } = options;
        let ensemble = *ensemble;
        let pixels = frame.width * frame.height;
        if !layers.is_empty() {
            self.check_layers(ensemble)
                .and_then(|()| check_layer_sizes(layers, pixels))
                .map_err(|source| DenoiseError::Layers {
                    name: frame.name.clone(),
                    source,
                })?;
        }
        let scale = || match input_scale {
            Some(scale) => *scale,
            None => self.input_scale(self.exposure(&frame.color, frame.height, frame.width)),
        };
        let input = || FrameInput::new(self, frame);
        let statistics = || self.check_statistics(frame);
        let (input, (statistics, scale)) = rayon::join(input, || rayon::join(statistics, scale));
        let mut input = input?;
        statistics?;
        input.ensemble = ensemble;
        input.scale = scale;
        let observer: &mut DenoiseObserver = &mut observer;
        let size = Padding {
            height: frame.height,
            width: frame.width,
            unit: self.unit(),
        };
        let tiles = self
            .tiles_beside([outputs(frame), layers.len()], size, tiling, ensemble)
            .map_err(|source| DenoiseError::Memory {
                name: frame.name.clone(),
                source,
            })?;
        input.filter_albedo(tiling, observer)?;
        let restores_light = restore_light.unwrap_or(self.meta.normalizer.restore_light);
        let (filtered, own): (&[Layer], &[Layer]) = if self.filters_layers() {
            (layers, &[])
        } else {
            (&[], layers)
        };
        let images = LayerImages::new(own);
        input.layers = filtered;
        let mut color_hdr = input.denoise(&tiles, &mut of_pass(observer, [0, images.passes()]))?;
        let mut layer_planes = color_hdr.split_off(COLOR_CHANNELS * pixels);
        input.layers = &[];
        layer_planes.extend(images.denoise(&input, &tiles, restores_light, observer)?);
        let alpha = input.denoise_alpha(&tiles, observer)?;
        let seam_error = if tiling.is_exact() {
            None
        } else {
            input.seam_error(&tiles, &color_hdr, observer)?
        };
        if restores_light {
            let factors = light::factors(&frame.color, &color_hdr, frame.height, frame.width);
            light::multiply(&mut color_hdr, &factors);
            let colors = filtered.iter().map(Layer::color);
            for (plane, color) in layer_planes.chunks_mut(pixels).zip(colors) {
                if let Some(color) = color {
                    light::multiply(plane, &factors[color * pixels..(color + 1) * pixels]);
                }
            }
        }
        images.scale(&mut layer_planes, &frame.color, &color_hdr);
        Ok(Denoised {
            color_hdr,
            alpha,
            layers: layer_planes,
            tiles,
            seam_error,
        })
    }

    /// The exposure of planar colour `[3, H, W]`, linear HDR, as this model measures it.
    pub fn exposure(&self, color_hdr: &[f32], height: usize, width: usize) -> f64 {
        let transfer = self.meta.normalizer.transfer;
        transfer.exposure(color_hdr, height, width)
    }

    /// The sides of an image are padded to multiples of this, in pixels.
    pub(crate) fn unit(&self) -> usize {
        1 << self.meta.model.variant.spec().halvings
    }

    /// The factor on the colour of an image with this [`exposure`](Self::exposure).
    ///
    /// It brings the image to the exposure level of training. It is 1 for a black image.
    ///
    /// A model without such a level scales only images more than a stop outside the training scenes'
    /// range, to the geometric middle of that range.
    pub fn input_scale(&self, exposure: f64) -> f32 {
        if let Some(level) = self.meta.normalizer.exposure_level {
            return exposure_scale(level, exposure);
        }
        let Some(Ranges {
            exposure: range, ..
        }) = &self.meta.ranges
        else {
            return 1.0;
        };
        let (low, high) = (f64::from(range.low), f64::from(range.high));
        let is_usual = (low / TOLERANCE..=high * TOLERANCE).contains(&exposure);
        if is_usual {
            1.0
        } else {
            exposure_scale((low * high).sqrt() as f32, exposure)
        }
    }

    /// The output of an ONNX graph of this network ([`crate::onnx`]) for `frame`: as
    /// [`denoise`](Self::denoise), but without the factor on the colour and the mapping of the
    /// positions.
    ///
    /// # Errors
    /// As [`denoise`](Self::denoise).
    pub(crate) fn run_graph(&self, frame: &Frame) -> Result<Vec<f32>, DenoiseError> {
        let mut input = FrameInput::with_positions(self, frame, None)?;
        input.filter_albedo(&Tiling::default(), &mut unobserved)?;
        let padded = (input.padding.padded_height(), input.padding.padded_width());
        let tiles = Tiles::plan(padded, &Tiling::default(), |_, _| 0, None);
        input.denoise(&tiles.expect("no limit on memory"), &mut unobserved)
    }

    /// The tiles that [`denoise_with`](Self::denoise_with) would cut an image of `height` x
    /// `width` pixels into now.
    ///
    /// # Errors
    /// The smallest tile does not fit into memory.
    pub fn tiles(
        &self,
        height: usize,
        width: usize,
        tiling: &Tiling,
        ensemble: Ensemble,
    ) -> Result<Tiles, memory::TooLarge> {
        let size = Padding {
            height,
            width,
            unit: self.unit(),
        };
        self.tiles_beside([COLOR_CHANNELS, 0], size, tiling, ensemble)
    }

    /// As [`tiles`](Self::tiles), for an image with this number of output planes beside the layers.
    fn tiles_beside(
        &self,
        [outputs, layers]: [usize; 2],
        size: Padding,
        tiling: &Tiling,
        ensemble: Ensemble,
    ) -> Result<Tiles, memory::TooLarge> {
        let padded = (size.padded_height(), size.padded_width());
        let budget = tiling.memory.or_else(|| {
            let planes = outputs + self.layer_planes(layers);
            let output = (planes * size.height * size.width * size_of::<f32>()) as u64;
            Some(self.memory_budget()?.saturating_sub(output))
        });
        let demodulates = self.meta.normalizer.albedo_demodulation_epsilon.is_some();
        let planes = match self.meta.layout.inputs {
            InputKind::Kpcn => PASS_PLANES + FEATURES + COLOR_CHANNELS,
            InputKind::Demc if demodulates => COLOR_CHANNELS,
            InputKind::Demc => 0,
        };
        let colors = self.meta.model.variant.spec().color_channels;
        let extra = (planes * size_of::<f32>()) as u64
            + ensemble.bytes_per_pixel(colors + FEATURES, colors);
        let images = self.filtered_images(layers);
        let need = |height, width| {
            self.pass_bytes_with(images, height, width) + extra * (height * width) as u64
        };
        Tiles::plan(padded, tiling, need, budget)
    }

    /// Bytes that a pass over `height` x `width` pixels (multiples of 32) needs in addition to the
    /// weights.
    pub fn pass_bytes(&self, height: usize, width: usize) -> u64 {
        self.pass_bytes_with(0, height, width)
    }

    /// As [`pass_bytes`](Self::pass_bytes), with this number of images of three layers.
    fn pass_bytes_with(&self, images: usize, height: usize, width: usize) -> u64 {
        let ops = self.model.ops().on(&self.device());
        demc_model::inference::pass_bytes(ops, self.model.config(), height, width, images)
    }

    /// Bytes that a pass may use now on the model's device; `None` if unknown.
    pub fn memory_budget(&self) -> Option<u64> {
        memory::budget(&self.device())
    }

    /// The detail map of the fusion sub-network (Fig. 2 e), for inspection; `None` for a variant
    /// without one.
    ///
    /// # Shapes
    /// Planar `[3, H, W]`, not negative, without a unit.
    ///
    /// # Errors
    /// As [`denoise`](Self::denoise).
    pub fn detail_map(&self, frame: &Frame) -> Result<Option<Vec<f32>>, DenoiseError> {
        if !self.model.config().variant.spec().has_fusion() {
            return Ok(None);
        }
        let mut input = FrameInput::new(self, frame)?;
        input.filter_albedo(&Tiling::default(), &mut unobserved)?;
        let padding = input.padding;
        // The four convolutions reach 4 pixels.
        let tiling = Tiling {
            halo: DOWNSAMPLING,
            side: Some(DETAIL_TILE),
            memory: None,
        };
        let padded = (padding.padded_height(), padding.padded_width());
        let tiles = Tiles::plan(padded, &tiling, |_, _| 0, None).expect("no limit on memory");
        let mut out = vec![0.0; DETAIL_CHANNELS * frame.height * frame.width];
        for (rows, columns) in tiles.iter() {
            let features = input.features_z(rows.read.clone(), columns.read.clone());
            let map = self.model.detail_map(features).expect("a variant with one");
            padding.paste(&input.read(map)?, rows, columns, &mut out);
        }
        Ok(Some(out))
    }

    pub(crate) fn device(&self) -> Device {
        let devices = self.model.devices();
        devices.first().expect("every network has weights").clone()
    }
}

/// Number of planes that are in memory beside a pass: the denoised colour and the filtered albedo.
/// With alpha, there are also alpha as grey, its denoised image, the result, and the mask of its
/// edges.
fn outputs(frame: &Frame) -> usize {
    match frame.alpha {
        Some(_) => 4 * COLOR_CHANNELS + 2,
        None => 2 * COLOR_CHANNELS,
    }
}
