//! The perceptually uniform curve (PU) of Open Image Denoise 2, and its constants.
//!
//! A radiance `y` becomes `A y` up to [`Y0`], `B y^C + D` up to [`Y1`], and `E ln(y + F) + G` above. The
//! networks' colour is that divided by the curve's value at [`PEAK`].

/// Largest radiance, where the networks' colour is 1: half precision's largest value.
pub const PEAK: f32 = 65504.0;
/// Slope of the darkest part.
pub const A: f32 = 1_412.837_6;
/// Factor of the middle part.
pub const B: f32 = 1.645_931_7;
/// Exponent of the middle part.
pub const C: f32 = 0.431_384_98;
/// Summand of the middle part.
pub const D: f32 = -0.002_941_396;
/// Factor of the brightest part.
pub const E: f32 = 0.192_653_25;
/// Summand in the logarithm of the brightest part.
pub const F: f32 = 0.006_260_261;
/// Summand of the brightest part.
pub const G: f32 = 0.998_620_15;
/// Radiance at the end of the darkest part.
pub const Y0: f32 = 1.579_457_6e-6;
/// Radiance at the end of the middle part.
pub const Y1: f32 = 0.032_208_763;
/// The curve's value at [`Y0`].
pub const X0: f32 = 0.002_231_517;
/// The curve's value at [`Y1`].
pub const X1: f32 = 0.370_974_75;

/// The curve's value of a radiance that is not negative.
pub fn value(radiance: f32) -> f32 {
    if radiance <= Y0 {
        A * radiance
    } else if radiance <= Y1 {
        B * radiance.powf(C) + D
    } else {
        E * (radiance + F).ln() + G
    }
}

/// The radiance of a value of the curve that is not negative.
pub fn inverse(value: f32) -> f32 {
    if value <= X0 {
        value / A
    } else if value <= X1 {
        ((value - D) / B).powf(1.0 / C)
    } else {
        ((value - G) / E).exp() - F
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_meet_and_each_comes_back() {
        for (radiance, joint) in [(Y0, X0), (Y1, X1)] {
            for side in [0.9999, 1.0, 1.0001] {
                assert!((value(side * radiance) / joint - 1.0).abs() < 1e-3);
                assert!((inverse(side * joint) / radiance - 1.0).abs() < 1e-3);
            }
        }
        for radiance in [0.0, 1e-7, 1e-4, 0.02, 0.5, 900.0, PEAK] {
            assert!((inverse(value(radiance)) - radiance).abs() <= 1e-4 * radiance);
        }
    }
}
