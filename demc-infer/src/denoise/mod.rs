//! Denoises a frame: exposure and positions, padding and tiles, gamma, albedo demodulation and
//! Z-score, the network, and back to linear HDR.

mod seams;
#[cfg(test)]
mod tests;

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use demc_data::transform::exposure_scale;
use demc_data::{FEATURES, Frame, PositionMap, Ranges};
use demc_model::config::COLOR_CHANNELS;

use crate::Bundle;
use crate::ensemble::Ensemble;
use crate::error::check_sizes;
use crate::memory;
use crate::padding::Padding;
use crate::tiles::{Tiles, Tiling};

pub use crate::error::DenoiseError;
pub use demc_data::transform::MAX_INPUT_SCALE;
pub use seams::SeamError;

/// Exposures up to this factor outside the training scenes' range are not scaled: a stop, the
/// exposure augmentation of training. On the data set's scenes, a stop within the range changed the
/// error by up to 25 % in either direction.
const TOLERANCE: f64 = 2.0;

/// The exposure that alpha is scaled to for the network. On one image of Cycles, 0.05 gave a third of
/// the noisy alpha's squared error, 0.13 a half.
const ALPHA_LEVEL: f32 = 0.05;

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
}

/// A denoised image, and how it was made.
#[derive(Debug, Clone, PartialEq)]
pub struct Denoised {
    /// Planar `[3, H, W]`, linear HDR, not negative.
    pub color_hdr: Vec<f32>,
    /// The denoised alpha `[H, W]`, for a frame whose alpha varies.
    pub alpha: Option<Vec<f32>>,
    /// The tiles that the image was cut into.
    pub tiles: Tiles,
    /// The error of a halo below the exact one, measured at seams; `None` for exact tiles or a
    /// single tile.
    pub seam_error: Option<SeamError>,
}

impl Bundle {
    /// Denoises `frame`, of any size that a file can have ([`demc_data::exr::check_size`]).
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
        self.denoise_with(frame, &DenoiseOptions::default(), |_, _| ())
            .map(|denoised| denoised.color_hdr)
    }

    /// As [`denoise`](Self::denoise), with options.
    ///
    /// `progress` is called before each tile with the number of finished tiles and of all tiles.
    ///
    /// # Errors
    /// As [`denoise`](Self::denoise).
    pub fn denoise_with(
        &self,
        frame: &Frame,
        options: &DenoiseOptions,
        progress: impl FnMut(usize, usize),
    ) -> Result<Denoised, DenoiseError> {
        let DenoiseOptions {
            tiling,
            ensemble,
            input_scale,
        } = options;
        let ensemble = *ensemble;
        let mut input = FrameInput::new(self, frame)?;
        input.ensemble = ensemble;
        input.scale = match input_scale {
            Some(scale) => *scale,
            None => self.input_scale(demc_data::ranges::exposure(&frame.color)),
        };
        self.check_statistics(frame)?;
        let tiles = self
            .tiles_beside(outputs(frame), frame.height, frame.width, tiling, ensemble)
            .map_err(|source| DenoiseError::Memory {
                name: frame.name.clone(),
                source,
            })?;
        let color_hdr = input.denoise(&tiles, progress)?;
        let alpha = input.denoise_alpha(&tiles)?;
        let seam_error = match tiling.is_exact() {
            true => None,
            false => input.seam_error(&tiles, &color_hdr)?,
        };
        Ok(Denoised {
            color_hdr,
            alpha,
            tiles,
            seam_error,
        })
    }

    /// The factor on the colour of an image with this [`exposure`](demc_data::ranges::exposure).
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
        match is_usual {
            true => 1.0,
            false => exposure_scale((low * high).sqrt() as f32, exposure),
        }
    }

    /// The output of an ONNX graph of this network ([`crate::onnx`]) for `frame`: as
    /// [`denoise`](Self::denoise), but without the factor on the colour and the mapping of the
    /// positions.
    ///
    /// # Errors
    /// As [`denoise`](Self::denoise).
    pub(crate) fn run_graph(&self, frame: &Frame) -> Result<Vec<f32>, DenoiseError> {
        let input = FrameInput {
            positions: None,
            ..FrameInput::new(self, frame)?
        };
        let padded = (input.padding.padded_height(), input.padding.padded_width());
        let tiles = Tiles::plan(padded, &Tiling::default(), |_, _| 0, None);
        input.denoise(&tiles.expect("no limit on memory"), |_, _| ())
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
        self.tiles_beside(COLOR_CHANNELS, height, width, tiling, ensemble)
    }

    /// As [`tiles`](Self::tiles), for an image with this number of output planes.
    fn tiles_beside(
        &self,
        outputs: usize,
        height: usize,
        width: usize,
        tiling: &Tiling,
        ensemble: Ensemble,
    ) -> Result<Tiles, memory::TooLarge> {
        let padding = Padding { height, width };
        let padded = (padding.padded_height(), padding.padded_width());
        let budget = tiling.memory.or_else(|| {
            let output = (outputs * height * width * size_of::<f32>()) as u64;
            Some(self.memory_budget()?.saturating_sub(output))
        });
        let modulation = match self.meta.normalizer.albedo_demodulation_epsilon {
            Some(_) => (COLOR_CHANNELS * size_of::<f32>()) as u64,
            None => 0,
        };
        let extra =
            modulation + ensemble.bytes_per_pixel(COLOR_CHANNELS + FEATURES, COLOR_CHANNELS);
        let need = |height, width| self.pass_bytes(height, width) + extra * (height * width) as u64;
        Tiles::plan(padded, tiling, need, budget)
    }

    /// Bytes that a pass over `height` x `width` pixels (multiples of 32) needs in addition to the
    /// weights.
    pub fn pass_bytes(&self, height: usize, width: usize) -> u64 {
        let ops = self.model.ops().on(&self.device());
        demc_model::inference::pass_bytes(ops, self.model.config(), height, width)
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
        let input = FrameInput::new(self, frame)?;
        let (height, width) = (input.padding.padded_height(), input.padding.padded_width());
        let map = self.model.detail_map(input.features_z(0..height, 0..width));
        let map = map.map(|map| input.read(map)).transpose()?;
        Ok(map.map(|map| input.padding.crop(&map)))
    }

    pub(crate) fn device(&self) -> Device {
        let devices = self.model.devices();
        devices.first().expect("every network has weights").clone()
    }
}

/// Number of planes that are in memory beside a pass: the denoised colour; with alpha, also alpha as
/// grey, its denoised image, the result, and the mask of its edges.
fn outputs(frame: &Frame) -> usize {
    match frame.alpha {
        Some(_) => 3 * COLOR_CHANNELS + 2,
        None => COLOR_CHANNELS,
    }
}

struct FrameInput<'a> {
    bundle: &'a Bundle,
    frame: &'a Frame,
    /// The image that is denoised, planar `[3, H, W]`: the frame's colour, or its alpha as grey.
    color: &'a [f32],
    padding: Padding,
    device: Device,
    ensemble: Ensemble,
    /// Factor on the colour before the network.
    scale: f32,
    /// Whether a model with albedo demodulation divides by the albedo.
    demodulate: bool,
    /// Where a model takes positions relative to the image.
    positions: Option<PositionMap>,
}

/// For each pixel of `[height, width]`: whether it or one of its 8 neighbours has another value.
fn varies(plane: &[f32], height: usize, width: usize) -> Vec<bool> {
    let around = |i: usize, length: usize| i.saturating_sub(1)..(i + 2).min(length);
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (y, x)));
    let differs = |(y, x): (usize, usize)| {
        let own = plane[y * width + x];
        around(y, height).any(|y| around(x, width).any(|x| plane[y * width + x] != own))
    };
    pixels.map(differs).collect()
}

/// Rows or columns of the padded image, in pixels.
type PixelRange = std::ops::Range<usize>;

impl<'a> FrameInput<'a> {
    /// The input of one pass; fails for buffers of the wrong size.
    fn new(bundle: &'a Bundle, frame: &'a Frame) -> Result<Self, DenoiseError> {
        check_sizes(frame)?;
        Ok(Self {
            bundle,
            frame,
            color: &frame.color,
            padding: Padding {
                height: frame.height,
                width: frame.width,
            },
            device: bundle.device(),
            ensemble: Ensemble::One,
            scale: 1.0,
            demodulate: true,
            positions: bundle.meta.normalizer.position_map(&frame.features),
        })
    }

    /// Denoises tile by tile.
    ///
    /// # Shapes
    /// Returns planar `[3, H, W]` in linear HDR.
    fn denoise(
        &self,
        tiles: &Tiles,
        mut progress: impl FnMut(usize, usize),
    ) -> Result<Vec<f32>, DenoiseError> {
        let mut out = vec![0.0; self.color.len()];
        let mut bad = 0;
        for (done, (rows, columns)) in tiles.iter().enumerate() {
            progress(done, tiles.count());
            let tile = self.tile(&rows.read, &columns.read)?;
            bad += tile.iter().filter(|x| !x.is_finite()).count();
            self.padding.paste(&tile, rows, columns, &mut out);
        }
        match bad {
            0 => Ok(out),
            count => Err(DenoiseError::NonFinite {
                name: self.frame.name.clone(),
                count,
            }),
        }
    }

    /// The denoised alpha: where it varies, the mean of the rendered one and of the network's image of
    /// it. `None` for an image without alpha, or where it varies nowhere.
    ///
    /// # Shapes
    /// Returns `[H, W]`, from 0 to 1.
    fn denoise_alpha(&self, tiles: &Tiles) -> Result<Option<Vec<f32>>, DenoiseError> {
        let Some(alpha) = &self.frame.alpha else {
            return Ok(None);
        };
        let varies = varies(alpha, self.frame.height, self.frame.width);
        if !varies.contains(&true) {
            return Ok(None);
        }
        let grey = alpha.repeat(COLOR_CHANNELS);
        let input = FrameInput {
            bundle: self.bundle,
            frame: self.frame,
            color: &grey,
            padding: self.padding,
            device: self.device.clone(),
            ensemble: self.ensemble,
            scale: exposure_scale(ALPHA_LEVEL, demc_data::ranges::exposure(&grey)),
            demodulate: false,
            positions: self.positions,
        };
        let image = input.denoise(tiles, |_, _| ())?;
        let pixels = alpha.len();
        let denoised = alpha
            .iter()
            .enumerate()
            .map(|(i, rendered)| match varies[i] {
                false => *rendered,
                true => {
                    let channels = (0..COLOR_CHANNELS).map(|channel| image[channel * pixels + i]);
                    let mean = channels.sum::<f32>() / COLOR_CHANNELS as f32;
                    (rendered + mean.clamp(0.0, 1.0)) / 2.0
                }
            });
        Ok(Some(denoised.collect()))
    }

    /// Denoises one tile. NaN in the network's output stays NaN.
    ///
    /// # Shapes
    /// Returns `[3, rows, columns]` in linear HDR.
    fn tile(&self, rows: &PixelRange, columns: &PixelRange) -> Result<Vec<f32>, DenoiseError> {
        let normalizer = &self.bundle.meta.normalizer;
        let mut color = self.padding.cut(self.color, rows.clone(), columns.clone());
        color.iter_mut().for_each(|value| *value *= self.scale);
        let mut features = self.features(rows, columns);
        let modulation = match self.demodulate {
            true => normalizer.modulation(&features),
            false => None,
        };
        normalizer.color_gamma_from_hdr(&mut color, modulation.as_deref());
        normalizer.features_z_from_raw(&mut features);
        let color_gamma = self.tensor::<COLOR_CHANNELS>(color, rows, columns);
        let features_z = self.tensor::<FEATURES>(features, rows, columns);
        let out = self
            .ensemble
            .mean([color_gamma, features_z], |[color, features]| {
                self.bundle.model.forward(color, features)
            });
        let mut out = self.read(out)?;
        // The conversion to HDR would turn NaN into 0.
        let nan: Vec<usize> = (0..out.len()).filter(|i| out[*i].is_nan()).collect();
        normalizer.color_hdr_from_gamma(&mut out, modulation.as_deref());
        nan.into_iter().for_each(|i| out[i] = f32::NAN);
        out.iter_mut().for_each(|value| *value /= self.scale);
        Ok(out)
    }

    fn features(&self, rows: &PixelRange, columns: &PixelRange) -> Vec<f32> {
        let features = &self.frame.features;
        let mut features = self.padding.cut(features, rows.clone(), columns.clone());
        if let Some(positions) = &self.positions {
            positions.apply(&mut features);
        }
        features
    }

    fn features_z(&self, rows: PixelRange, columns: PixelRange) -> Tensor<4> {
        let mut planes = self.features(&rows, &columns);
        self.bundle.meta.normalizer.features_z_from_raw(&mut planes);
        self.tensor::<FEATURES>(planes, &rows, &columns)
    }

    fn tensor<const CHANNELS: usize>(
        &self,
        planes: Vec<f32>,
        rows: &PixelRange,
        columns: &PixelRange,
    ) -> Tensor<4> {
        let shape = [1, CHANNELS, rows.len(), columns.len()];
        Tensor::from_data(TensorData::new(planes, shape), &self.device)
    }

    fn read(&self, out: Tensor<4>) -> Result<Vec<f32>, DenoiseError> {
        out.try_into_vec_as::<f32>()
            .map_err(|source| DenoiseError::Device {
                name: self.frame.name.clone(),
                source,
            })
    }
}
