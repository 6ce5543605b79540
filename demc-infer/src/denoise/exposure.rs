//! Auto-exposure: scales an image's colour to the level of the training scenes.
//!
//! Light is linear, the network is not: a factor of 0.01 on the colour multiplied its error by 10.

use demc_data::Ranges;

use crate::Bundle;

/// Largest factor on the colour, and the inverse of the smallest.
pub const MAX_INPUT_SCALE: f32 = 1e6;

/// Exposures up to this factor outside the training scenes' range are not scaled: a stop, the
/// exposure augmentation of training. On the data set's scenes, a stop within the range changed the
/// error by up to 25 % in either direction.
const TOLERANCE: f64 = 2.0;

impl Bundle {
    /// The factor on the colour of an image with this [`exposure`](demc_data::ranges::exposure).
    ///
    /// It is 1 within a stop of the training scenes' range. Otherwise it brings the image to the
    /// geometric middle of that range. It is 1 for a black image and for a model without ranges.
    pub fn input_scale(&self, exposure: f64) -> f32 {
        let Some(Ranges {
            exposure: range, ..
        }) = &self.meta.ranges
        else {
            return 1.0;
        };
        let (low, high) = (f64::from(range.low), f64::from(range.high));
        let is_usual = (low / TOLERANCE..=high * TOLERANCE).contains(&exposure);
        let scale = (low * high).sqrt() / exposure;
        if is_usual || !scale.is_finite() {
            return 1.0;
        }
        let limit = f64::from(MAX_INPUT_SCALE);
        scale.clamp(1.0 / limit, limit) as f32
    }
}
