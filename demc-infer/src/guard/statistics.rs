//! Refuses an image whose feature buffers are nowhere near those of the training scenes.

use demc_data::Frame;
use demc_data::frame::FEATURE_NAMES;

use crate::Bundle;
use crate::denoise::{DenoiseError, check_sizes};

/// How many training deviations a feature channel may lie from the training mean, root mean square over its pixels.
///
/// Ours. With the quick-start statistics (8 scenes), the farthest channel of the data set's 108 scenes is 13.8
/// (position.y of `col-tire-1`). Their positions in millimetres reach 1000 in the sample's classroom and this limit in
/// 100 of the 108 scenes; the other 8 are generated, small and near the training mean.
pub const FARTHEST_RMS: f64 = 100.0;

/// Channels whose misses are left out, as in the statistics: normal xyz and position xyz.
const GEOMETRY: usize = 6;

impl Bundle {
    /// Refuses a frame with a feature channel that is nowhere near the training scenes: root mean square of
    /// `(x - mean) / deviation` at [`FARTHEST_RMS`] or more. Normals and positions count where the mask says that
    /// something was hit, as in the statistics; [`denoise`](Self::denoise) begins with this check.
    ///
    /// # Errors
    /// The first such channel, by name; buffers that do not fit the frame's size.
    pub fn check_statistics(&self, frame: &Frame) -> Result<(), DenoiseError> {
        check_sizes(frame)?;
        let stats = &self.meta.normalizer.features;
        let planes = frame.features.chunks_exact(frame.height * frame.width);
        for (i, plane) in planes.enumerate() {
            let mask = frame.mask.as_deref().filter(|_| i < GEOMETRY);
            let (mean, std) = (stats.mean[i], stats.std[i]);
            let rms = rms_z(plane, mask, f64::from(mean), f64::from(std));
            // NaN, which only a frame that no file was read for can hold, fits nothing either.
            if rms >= FARTHEST_RMS || rms.is_nan() {
                return Err(DenoiseError::Statistics {
                    name: frame.name.clone(),
                    channel: FEATURE_NAMES[i],
                    rms,
                    mean,
                    std,
                });
            }
        }
        Ok(())
    }
}

/// Root mean square of `(x - mean) / std` over the pixels with `mask` > 0, or over all; 0 where there are none.
fn rms_z(plane: &[f32], mask: Option<&[f32]>, mean: f64, std: f64) -> f64 {
    let (mut sum, mut count) = (0.0, 0_usize);
    for (pixel, &x) in plane.iter().enumerate() {
        if mask.is_none_or(|mask| mask[pixel] > 0.0) {
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

    /// A frame of 8x8 whose position.x alternates between `deviations` and `-deviations` around the training mean.
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
            "pattern: position.x does not fit the model's statistics: 1000.0 deviations from the training mean (root \
             mean square; at most 100), in training mean 0.3000 with a deviation of 0.6000; another unit or another \
             buffer?"
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
        frame.features[6 * 64..7 * 64].fill(1000.0);
        let error = bundle.check_statistics(&frame).expect_err("a texture");
        assert!(error.to_string().contains("texture1.r"), "{error}");

        frame.mask = Some(vec![1.0; 63]);
        let error = bundle.check_statistics(&frame).expect_err("a short mask");
        assert!(error.to_string().contains("mask holds 63"), "{error}");
    }
}
