//! Compares the mean of an output with that of its input. A path tracer's noisy image is unbiased,
//! so no reference is needed.

use demc_data::Frame;
use demc_data::check::geometry::Warning;
use demc_model::config::COLOR_CHANNELS;

/// Smallest bias that causes a warning (ours).
const MIN_BIAS: f64 = 0.1;

/// Smallest number of standard errors that causes a warning; less may be noise in the input (ours).
const MIN_STANDARD_ERRORS: f64 = 4.0;

/// The relative difference between the means of an output and its input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EnergyBias {
    /// Mean of the output divided by mean of the input, minus 1, over all channels of linear HDR; 0
    /// for a black input.
    pub bias: f64,
    /// Standard error of [`bias`](Self::bias) due to the input's noise, estimated from the
    /// differences between output and input per pixel.
    pub standard_error: f64,
}

impl EnergyBias {
    /// Measures `frame` and its denoised image.
    ///
    /// # Shapes
    /// `denoised_hdr` is planar `[3, H, W]` in linear HDR.
    pub fn of(frame: &Frame, denoised_hdr: &[f32]) -> Self {
        let pixels = frame.color.len() / COLOR_CHANNELS;
        let sum = |image: &[f32], i: usize| -> f64 {
            (0..COLOR_CHANNELS)
                .map(|c| f64::from(image[c * pixels + i]))
                .sum()
        };
        let count = pixels.max(1) as f64;
        let mean = (0..pixels).map(|i| sum(&frame.color, i)).sum::<f64>() / count;
        if mean <= 0.0 {
            return Self {
                bias: 0.0,
                standard_error: 0.0,
            };
        }
        let difference = |i| sum(denoised_hdr, i) - sum(&frame.color, i);
        let bias = (0..pixels).map(difference).sum::<f64>() / count;
        let squares = (0..pixels)
            .map(|i| (difference(i) - bias).powi(2))
            .sum::<f64>();
        Self {
            bias: bias / mean,
            standard_error: squares.sqrt() / count / mean,
        }
    }

    /// A warning if the bias is large and significant.
    pub fn warning(self) -> Option<Warning> {
        let Self {
            bias,
            standard_error,
        } = self;
        let significant = bias.abs() > MIN_STANDARD_ERRORS * standard_error;
        (bias.abs() > MIN_BIAS && significant).then(|| Warning {
            what: "output".into(),
            found: format!(
                "its mean is {:.0} % {} the input's (+- {:.1} %)",
                100.0 * bias.abs(),
                if bias < 0.0 { "below" } else { "above" },
                100.0 * standard_error
            ),
            cause: "the network removes or adds light; compare it with a converged render before you use it",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bundle::testing::frame;

    #[test]
    fn a_scaled_image_is_biased_by_the_scale() {
        let frame = frame(40, 30);
        for scale in [0.5f32, 1.0, 1.5] {
            let denoised: Vec<f32> = frame.color.iter().map(|x| x * scale).collect();
            let energy = EnergyBias::of(&frame, &denoised);
            assert!((energy.bias - f64::from(scale - 1.0)).abs() < 1e-6);
            assert_eq!(energy.warning().is_some(), scale != 1.0);
        }
    }

    #[test]
    fn a_firefly_causes_no_warning() {
        let mut frame = frame(40, 30);
        let denoised = frame.color.clone();
        frame.color[7] = 3000.0;
        let energy = EnergyBias::of(&frame, &denoised);
        assert!(
            energy.bias < -0.5 && energy.warning().is_none(),
            "{energy:?}"
        );
    }

    #[test]
    fn black_has_no_bias() {
        let mut frame = frame(4, 4);
        frame.color.fill(0.0);
        let energy = EnergyBias::of(&frame, &frame.color);
        assert_eq!((energy.bias, energy.warning()), (0.0, None));
    }
}
