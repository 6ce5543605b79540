//! Checks of an image against the data that the network was trained on.
//!
//! - [`Bundle::check_statistics`] refuses an image whose result would be nonsense.
//! - [`Bundle::warnings`] lists signs that the result will be poor.
//! - [`EnergyBias`] compares the mean of the output with that of the noisy input. It needs no
//!   reference, because the noisy input is unbiased.
//!
//! A renderer that writes a wrong buffer causes no error: normals in camera space, normals packed
//! into 0 to 1, swapped buffers. Known mistakes are tested first ([`demc_data::check::geometry`]).
//! The other channels are compared with the ranges of the training scenes (`drift`).

mod drift;
mod energy;

use demc_data::check::geometry;
use demc_data::image::frame::{FEATURE_NAMES, MAX_ALBEDO, POSITIONS, TEXTURES};
use demc_data::input::transform::MAX_INPUT_SCALE;
use demc_data::{Frame, FrameSummary};

use crate::Bundle;
use crate::error::{DenoiseError, check_sizes};

pub use demc_data::check::geometry::Warning;
pub use energy::EnergyBias;

/// Largest distance of a feature channel from the training mean, in training deviations: the root
/// mean square over its pixels.
///
/// Ours. With the quick start's statistics (8 scenes), the farthest channel of the data set's 108
/// scenes is at 13.8 (position.y of `col-tire-1`). With positions in millimetres, the sample's
/// classroom is at 1000, and 100 of the 108 scenes exceed this limit. The other 8 are generated,
/// small and near the training mean.
pub const FARTHEST_RMS: f64 = 100.0;

impl Bundle {
    /// Lists how `frame` differs from the training data. The list is empty for an image like the
    /// training scenes.
    ///
    /// # Errors
    /// A buffer that does not have the frame's size.
    pub fn warnings(&self, frame: &Frame) -> Result<Vec<Warning>, DenoiseError> {
        check_sizes(frame)?;
        let summary = || self.meta.ranges.as_ref().map(|_| FrameSummary::of(frame));
        let (mut warnings, summary) = rayon::join(|| geometry::warnings(frame), summary);
        // A buffer with a known mistake also drifts: one warning is enough.
        if let Some((ranges, summary)) = self.meta.ranges.as_ref().zip(summary) {
            let known: Vec<String> = warnings.iter().map(|w| w.what.clone()).collect();
            let position = self.meta.normalizer.position;
            let drift = drift::warnings(&summary, ranges, position);
            let named = |warning: &Warning| known.iter().any(|what| warning.what.contains(what));
            warnings.extend(drift.into_iter().filter(|warning| !named(warning)));
        }
        let exposure = self.exposure(&frame.color, frame.height, frame.width);
        warnings.extend(self.beyond_scale(exposure));
        Ok(warnings)
    }

    /// A warning about an exposure that the largest or smallest factor does not bring to that of training.
    fn beyond_scale(&self, exposure: f64) -> Option<Warning> {
        let inside = 1.0 / MAX_INPUT_SCALE..MAX_INPUT_SCALE;
        let scale = self.input_scale(exposure);
        let beyond = exposure > 0.0 && !(scale > inside.start && scale < inside.end);
        beyond.then(|| Warning {
            what: "exposure".into(),
            found: format!(
                "it is {exposure:.1e}, and the factor on the colour is limited to {scale:.0e}"
            ),
            cause: "is radiance in another unit?",
        })
    }

    /// Refuses a frame with a feature channel far from the training scenes: the root mean square of
    /// `(x - mean) / deviation` is [`FARTHEST_RMS`] or more.
    ///
    /// Normals and positions count only where the mask reports a hit, and albedo up to 1, as in the
    /// statistics. Features that the network does not take do not count.
    /// [`denoise`](Self::denoise) starts with this check.
    ///
    /// # Errors
    /// The first such channel, by name; a buffer that does not have the frame's size.
    pub fn check_statistics(&self, frame: &Frame) -> Result<(), DenoiseError> {
        check_sizes(frame)?;
        let stats = &self.meta.normalizer.features;
        let pixels = frame.height * frame.width;
        let planes = frame.features.chunks_exact(pixels).enumerate();
        // Mapped positions cannot be far.
        let mapped = !self.meta.normalizer.position.is_scene();
        let counts = |i: &usize| {
            let cannot_be_far = mapped && (POSITIONS..TEXTURES).contains(i);
            self.meta.model.takes_feature(*i) && !cannot_be_far
        };
        for (i, plane) in planes.filter(|(i, _)| counts(i)) {
            let mask = frame.mask.as_deref().filter(|_| i < TEXTURES);
            let largest = if i < TEXTURES { f32::MAX } else { MAX_ALBEDO };
            let (mean, std) = (stats.mean[i], stats.std[i]);
            let rms = rms_z(plane, mask, largest, [mean, std].map(f64::from));
            // Only a frame made in memory can hold NaN: reading a file refuses it.
            if rms >= FARTHEST_RMS || rms.is_nan() {
                return Err(DenoiseError::Statistics {
                    name: frame.name.clone(),
                    channel: FEATURE_NAMES[i],
                    rms,
                    limit: FARTHEST_RMS,
                    mean,
                    std,
                });
            }
        }
        Ok(())
    }
}

/// Root mean square of `(x - mean) / std`, with x up to `largest`, over the pixels with `mask` > 0, or over
/// all pixels without a mask; 0 for no pixels.
fn rms_z(plane: &[f32], mask: Option<&[f32]>, largest: f32, [mean, std]: [f64; 2]) -> f64 {
    let (mut sum, mut count) = (0.0, 0_usize);
    for (pixel, &x) in plane.iter().enumerate() {
        if mask.is_none_or(|mask| mask[pixel] > 0.0) {
            let x = if x > largest { largest } else { x };
            sum += ((f64::from(x) - mean) / std).powi(2);
            count += 1;
        }
    }
    (sum / count.max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bundle::testing::{bundle, frame};
    use demc_model::Variant;

    /// A frame of 8x8 pixels. Its position.x alternates between plus and minus `deviations`
    /// around the training mean.
    fn spread(bundle: &Bundle, deviations: f32) -> Frame {
        let stats = &bundle.meta.normalizer.features;
        let (mean, std) = (stats.mean[3], stats.std[3]);
        let mut frame = frame(8, 8);
        for (pixel, x) in frame.features[3 * 64..4 * 64].iter_mut().enumerate() {
            *x = mean
                + std
                    * if pixel % 2 == 0 {
                        deviations
                    } else {
                        -deviations
                    };
        }
        frame
    }

    #[test]
    fn a_scene_in_another_unit_is_refused_although_its_mean_fits() {
        let bundle = bundle(Variant::Demc);
        assert!(bundle.check_statistics(&spread(&bundle, 90.0)).is_ok());
        let frame = spread(&bundle, 1000.0);
        let error = bundle.check_statistics(&frame).expect_err("millimetres");
        assert_eq!(
            error.to_string(),
            "pattern: position.x does not fit the model's statistics: it is 1000.0 training \
             deviations from the training mean (root mean square, limit 100); training mean \
             0.3000, deviation 0.6000. Is it in another unit, or another buffer?"
        );
        assert!(bundle.denoise(&frame).is_err());
    }

    #[test]
    fn misses_count_for_textures_only() {
        let bundle = bundle(Variant::Demc);
        let mut frame = spread(&bundle, 1000.0);
        frame.mask = Some(vec![0.0; 64]);
        assert!(bundle.check_statistics(&frame).is_ok(), "nothing is hit");
        frame.mask = Some((0..64).map(|pixel| f32::from(pixel >= 62)).collect());
        assert!(bundle.check_statistics(&frame).is_err(), "two hits");

        frame.mask = Some(vec![0.0; 64]);
        frame.features[6 * 64..7 * 64].fill(-1000.0);
        let error = bundle.check_statistics(&frame).expect_err("a texture");
        assert!(error.to_string().contains("texture1.r"), "{error}");
        frame.features[6 * 64..7 * 64].fill(65504.0);
        assert!(bundle.check_statistics(&frame).is_ok(), "counts as 1");

        frame.mask = Some(vec![1.0; 63]);
        let error = bundle.check_statistics(&frame).expect_err("a short mask");
        assert!(error.to_string().contains("mask holds 63"), "{error}");
    }
}
