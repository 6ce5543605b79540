//! One frame as the network's input: tiles, conversions, and the passes over them.

use std::sync::Arc;

use burn::tensor::{Device, Tensor, TensorData};
use demc_data::image::frame::TEXTURES;
use demc_data::input::kpcn::{KpcnInput, LIGHT, radiance_from_light};
use demc_data::input::transform::exposure_scale;
use demc_data::{FEATURES, Frame, PositionMap};
use demc_model::Head;
use demc_model::config::COLOR_CHANNELS;
use demc_model::inference::Cancelled;
use rayon::prelude::*;

use super::layers::{Layer, LayerTile};
use super::progress::{DenoiseObserver, DenoiseProgress};
use crate::Bundle;
use crate::ensemble::Ensemble;
use crate::error::{DenoiseError, check_sizes};
use crate::padding::{Padding, PixelRange};
use crate::tiles::Tiles;

/// The exposure that alpha is scaled to for the network. On one image of Cycles, 0.05 gave a third of
/// the noisy alpha's squared error, 0.13 a half.
const ALPHA_LEVEL: f32 = 0.05;

/// A frame as the network takes it as input, tile by tile.
#[derive(Clone)]
pub(super) struct FrameInput<'a> {
    pub(super) bundle: &'a Bundle,
    pub(super) frame: &'a Frame,
    /// The image that is denoised, planar `[3, H, W]`: the frame's colour, its alpha as grey, or a layer.
    pub(super) color: &'a [f32],
    /// Channels that are filtered with its kernels.
    pub(super) layers: &'a [Layer],
    /// The filtered albedo of the first hit, which replaces the frame's: planar, padded `[3, H, W]`.
    pub(super) albedo: Option<Arc<[f32]>>,
    pub(super) padding: Padding,
    pub(super) device: Device,
    pub(super) ensemble: Ensemble,
    /// Factor on the colour before the network.
    pub(super) scale: f32,
    /// Whether a model with albedo demodulation divides by the albedo.
    pub(super) demodulate: bool,
    /// Where a model takes positions relative to the image.
    pub(super) positions: Option<PositionMap>,
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

impl<'a> FrameInput<'a> {
    /// The input of one pass; fails for buffers of the wrong size.
    pub(super) fn new(bundle: &'a Bundle, frame: &'a Frame) -> Result<Self, DenoiseError> {
        check_sizes(frame)?;
        let positions = bundle.meta.normalizer.position_map(&frame.features);
        Self::with_positions(bundle, frame, positions)
    }

    /// As [`new`](Self::new), with a known mapping of the positions.
    pub(super) fn with_positions(
        bundle: &'a Bundle,
        frame: &'a Frame,
        positions: Option<PositionMap>,
    ) -> Result<Self, DenoiseError> {
        check_sizes(frame)?;
        Ok(Self {
            bundle,
            frame,
            color: &frame.color,
            layers: &[],
            albedo: None,
            padding: Padding {
                height: frame.height,
                width: frame.width,
                unit: bundle.unit(),
            },
            device: bundle.device(),
            ensemble: Ensemble::One,
            scale: 1.0,
            demodulate: true,
            positions,
        })
    }

    /// The padded image as one without padding.
    pub(super) fn padded(&self) -> Padding {
        Padding {
            height: self.padding.padded_height(),
            width: self.padding.padded_width(),
            unit: self.padding.unit,
        }
    }

    /// Denoises tile by tile.
    ///
    /// # Shapes
    /// Returns planar `[3 + layers, H, W]` in linear HDR.
    pub(super) fn denoise(
        &self,
        tiles: &Tiles,
        observer: &mut DenoiseObserver,
    ) -> Result<Vec<f32>, DenoiseError> {
        self.denoise_into(self.padding, tiles, observer)
    }

    /// As [`denoise`](Self::denoise), but the output has the size of `size`: that of the image, or
    /// that of the padded one.
    pub(super) fn denoise_into(
        &self,
        size: Padding,
        tiles: &Tiles,
        observer: &mut DenoiseObserver,
    ) -> Result<Vec<f32>, DenoiseError> {
        let mut out = Vec::new();
        let mut bad = 0;
        for (done, (rows, columns)) in tiles.iter().enumerate() {
            let count = tiles.count();
            let place = |share| DenoiseProgress {
                tile: done,
                tiles: count,
                share: (done as f64 + share) / count as f64,
            };
            let tile = self.tile([&rows.read, &columns.read], observer, place)?;
            bad += tile.par_iter().filter(|x| !x.is_finite()).count();
            if (&rows.read, &columns.read) == (&(0..size.height), &(0..size.width)) {
                out = tile;
                continue;
            }
            let planes = COLOR_CHANNELS + self.layers.len();
            out.resize(planes * size.height * size.width, 0.0);
            size.paste(&tile, rows, columns, &mut out);
        }
        match bad {
            0 => Ok(out),
            count => Err(DenoiseError::NonFinite {
                name: self.frame.name.clone(),
                count,
            }),
        }
    }

    /// The denoised alpha: where it varies, the network's image of it, without a kernel head the mean of
    /// that and the rendered one. `None` for an image without alpha, where it varies nowhere, and for
    /// KPCN, which knows no image but the light.
    ///
    /// # Shapes
    /// Returns `[H, W]`, from 0 to 1.
    pub(super) fn denoise_alpha(
        &self,
        tiles: &Tiles,
        observer: &mut DenoiseObserver,
    ) -> Result<Option<Vec<f32>>, DenoiseError> {
        let Some(alpha) = &self.frame.alpha else {
            return Ok(None);
        };
        if !self.bundle.meta.layout.inputs.is_demc() {
            return Ok(None);
        }
        let varies = varies(alpha, self.frame.height, self.frame.width);
        if !varies.contains(&true) {
            return Ok(None);
        }
        let grey = alpha.repeat(COLOR_CHANNELS);
        let input = FrameInput {
            color: &grey,
            scale: exposure_scale(ALPHA_LEVEL, demc_data::input::ranges::exposure(&grey)),
            demodulate: false,
            ..self.clone()
        };
        let image = input.denoise(tiles, &mut |progress| {
            let share = 1.0;
            observer(DenoiseProgress { share, ..progress })
        })?;
        let pixels = alpha.len();
        // Squared error on one image of Cycles, relative to the noisy alpha: 0.65 instead of 0.79 with the
        // kernel head of `quality`. A grey head's image alone had 1.34, the mean 0.66.
        let share = match self.bundle.meta.model.head {
            Head::Kernel => 1.0,
            _ => 0.5,
        };
        let denoised = alpha.iter().enumerate().map(|(i, rendered)| {
            if varies[i] {
                let channels = (0..COLOR_CHANNELS).map(|channel| image[channel * pixels + i]);
                let mean = channels.sum::<f32>() / COLOR_CHANNELS as f32;
                (1.0 - share) * rendered + share * mean.clamp(0.0, 1.0)
            } else {
                *rendered
            }
        });
        Ok(Some(denoised.collect()))
    }

    /// Denoises one tile. NaN in the network's output stays NaN. `place` makes the image's progress of
    /// the tile's.
    ///
    /// # Shapes
    /// Returns `[3 + layers, rows, columns]` in linear HDR.
    pub(super) fn tile(
        &self,
        [rows, columns]: [&PixelRange; 2],
        observer: &mut DenoiseObserver,
        place: impl Fn(f64) -> DenoiseProgress,
    ) -> Result<Vec<f32>, DenoiseError> {
        let cancelled = |_| DenoiseError::Cancelled {
            name: self.frame.name.clone(),
        };
        if observer(place(0.0)).is_break() {
            return Err(cancelled(Cancelled));
        }
        let network = &self.bundle.model;
        let (mut pass, passes) = (0, self.ensemble.count() as f64);
        let mut forward = |[color, features]: [Tensor<4>; 2], layers: Option<Tensor<4>>| {
            let share = |share: f64| (f64::from(pass) + share) / passes;
            let mut observe = |done| observer(place(share(done)));
            let out = network.forward_observed(color, features, layers, &mut observe);
            pass += 1;
            out.map_err(cancelled)
        };
        if !self.bundle.meta.layout.inputs.is_demc() {
            return self.light_tile([rows, columns], |inputs| Ok(forward(inputs, None)?.0));
        }
        let normalizer = &self.bundle.meta.normalizer;
        let mut color = self.padding.cut(self.color, rows.clone(), columns.clone());
        let (modulation, features_z) = self.modulation_and_features(rows, columns);
        in_pieces(&mut color, modulation.as_deref(), |color, modulation| {
            color.iter_mut().for_each(|value| *value *= self.scale);
            normalizer.compress(color, modulation);
        });
        self.blank_padding(&mut color, rows, columns);
        let color_gamma = self.tensor::<COLOR_CHANNELS>(color, rows, columns);
        let layers = LayerTile::new(
            self.layers,
            modulation.as_deref(),
            normalizer.gamma,
            [rows, columns],
        );
        let inputs = [color_gamma, features_z];
        let (out, filtered) = if self.layers.is_empty() {
            let forward = |inputs| forward(inputs, None).map(|(out, _)| out);
            (self.ensemble.mean(inputs, forward)?, None)
        } else {
            forward(inputs, Some(layers.input(self.padding, &self.device)))?
        };
        let mut out = self.read(out)?;
        in_pieces(&mut out, modulation.as_deref(), |out, modulation| {
            // The conversion to HDR would turn NaN into 0.
            let nan: Vec<usize> = (0..out.len()).filter(|i| out[*i].is_nan()).collect();
            normalizer.expand(out, modulation);
            nan.into_iter().for_each(|i| out[i] = f32::NAN);
            out.iter_mut().for_each(|value| *value /= self.scale);
        });
        if let Some(filtered) = filtered {
            out.extend(layers.output(self.read(filtered)?));
        }
        Ok(out)
    }

    /// As [`tile`](Self::tile), for KPCN: `forward` takes light and features.
    ///
    /// # Shapes
    /// Returns `[3, rows, columns]` in linear HDR.
    ///
    /// # Errors
    /// A frame without passes; those of `forward`.
    fn light_tile(
        &self,
        [rows, columns]: [&PixelRange; 2],
        forward: impl FnMut([Tensor<4>; 2]) -> Result<Tensor<4>, DenoiseError>,
    ) -> Result<Vec<f32>, DenoiseError> {
        let Some(passes) = &self.frame.passes else {
            let name = self.frame.name.clone();
            return Err(DenoiseError::NoPasses { name });
        };
        let cut = |planes: &[f32]| self.padding.cut(planes, rows.clone(), columns.clone());
        let input = KpcnInput::new(&cut(passes), &cut(&self.frame.features), self.scale);
        let inputs = [
            self.tensor::<LIGHT>(input.light, rows, columns),
            self.tensor::<FEATURES>(input.features, rows, columns),
        ];
        let light = self.read(self.ensemble.mean(inputs, forward)?)?;
        Ok(radiance_from_light(&light, &input.divisor, self.scale))
    }

    /// The [modulation](demc_data::Normalizer::modulation) and the Z-scored features of a tile. A
    /// network without features gets zeros.
    fn modulation_and_features(
        &self,
        rows: &PixelRange,
        columns: &PixelRange,
    ) -> (Option<Vec<f32>>, Tensor<4>) {
        let meta = &self.bundle.meta;
        let demodulates = meta.normalizer.albedo_demodulation_epsilon.is_some();
        if !demodulates && !meta.model.takes_features() {
            let shape = [1, FEATURES, rows.len(), columns.len()];
            return (None, Tensor::<4>::zeros([1; 4], &self.device).expand(shape));
        }
        let mut features = self.features(rows, columns);
        let modulation = (self.demodulate && demodulates).then(|| {
            let pixels = rows.len() * columns.len();
            let mut albedo = features[TEXTURES * pixels..][..COLOR_CHANNELS * pixels].to_vec();
            in_pieces(&mut albedo, None, |albedo, _| {
                meta.normalizer.modulation_from_albedo(albedo);
            });
            albedo
        });
        meta.normalizer.features_z_from_raw(&mut features);
        self.blank_padding(&mut features, rows, columns);
        let features_z = self.tensor::<FEATURES>(features, rows, columns);
        (modulation, features_z)
    }

    /// Sets what is outside the image to 0, for a network that was trained so.
    ///
    /// # Shapes
    /// `planes` is `[C, rows, columns]`.
    fn blank_padding(&self, planes: &mut [f32], rows: &PixelRange, columns: &PixelRange) {
        if !self.bundle.meta.model.variant.spec().pads_with_zeros {
            return;
        }
        let inside =
            |range: &PixelRange, length: usize| length.clamp(range.start, range.end) - range.start;
        let [tall, wide] = [
            inside(rows, self.frame.height),
            inside(columns, self.frame.width),
        ];
        for plane in planes.chunks_exact_mut(rows.len() * columns.len()) {
            for (y, row) in plane.chunks_exact_mut(columns.len()).enumerate() {
                let end = if y < tall { wide } else { 0 };
                row[end..].fill(0.0);
            }
        }
    }

    fn features(&self, rows: &PixelRange, columns: &PixelRange) -> Vec<f32> {
        let whole = &self.frame.features;
        let mut features = self.padding.cut(whole, rows.clone(), columns.clone());
        if let Some(albedo) = &self.albedo {
            let albedo = self.padded().cut(albedo, rows.clone(), columns.clone());
            let first = TEXTURES * rows.len() * columns.len();
            features[first..][..albedo.len()].copy_from_slice(&albedo);
        }
        if let Some(positions) = &self.positions {
            positions.apply(&mut features);
        }
        features
    }

    pub(super) fn features_z(&self, rows: PixelRange, columns: PixelRange) -> Tensor<4> {
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

    pub(super) fn read(&self, out: Tensor<4>) -> Result<Vec<f32>, DenoiseError> {
        out.try_into_vec_as::<f32>()
            .map_err(|source| DenoiseError::Device {
                name: self.frame.name.clone(),
                source,
            })
    }
}

/// Values that a thread converts at a time.
const PIECE: usize = 1 << 15;

/// Runs `work` on pieces of the values and their modulation, on several threads.
fn in_pieces(
    values: &mut [f32],
    modulation: Option<&[f32]>,
    work: impl Fn(&mut [f32], Option<&[f32]>) + Sync,
) {
    let pieces = values.par_chunks_mut(PIECE).enumerate();
    pieces.for_each(|(piece, values)| {
        let first = piece * PIECE;
        work(
            values,
            modulation.map(|all| &all[first..first + values.len()]),
        );
    });
}
