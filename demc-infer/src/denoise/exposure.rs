//! Auto-exposure: scales an image's colour to the level of the training scenes.
//!
//! Light is linear, the network is not: a factor of 0.01 on the colour multiplied its error by 10.

use crate::Bundle;

/// Largest factor on the colour, and the inverse of the smallest.
pub const MAX_INPUT_SCALE: f32 = 1e6;

/// The factor from `exposure` to `target`; 1 for a black image.
pub fn input_scale(exposure: f64, target: f64) -> f32 {
    let limit = f64::from(MAX_INPUT_SCALE);
    match target / exposure {
        scale if scale.is_finite() => scale.clamp(1.0 / limit, limit) as f32,
        _ => 1.0,
    }
}

impl Bundle {
    /// The factor that brings an image of an [`exposure`](demc_data::ranges::exposure) to that of
    /// the brightest training scenes. The training's darker scenes are denoised better there, too.
    ///
    /// It is 1 for a black image and for a model without ranges.
    pub fn input_scale(&self, exposure: f64) -> f32 {
        match &self.meta.ranges {
            Some(ranges) => input_scale(exposure, f64::from(ranges.exposure.high)),
            None => 1.0,
        }
    }
}
