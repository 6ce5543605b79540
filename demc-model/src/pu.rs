//! The curve of Open Image Denoise ([`demc_kernels::pu`]) on tensors, with gradients.

use burn::tensor::Tensor;
use demc_kernels::pu::{A, B, C, D, E, F, G, PEAK, X0, X1, value as of_radiance};

/// Values above this many times the curve's peak have no gradient; their radiance nears the largest
/// float.
const BRIGHTEST: f32 = 2.0;

/// The radiance of network colours, which are 1 at the curve's peak. Negative ones count as 0.
///
/// # Shapes
/// Any to the same.
pub fn radiance(color: Tensor<4>) -> Tensor<4> {
    let peak = of_radiance(PEAK);
    let x = color.mul_scalar(peak).clamp(0.0, BRIGHTEST * peak);
    // Each part has a gradient for its own values only.
    let middle = (x.clone().clamp(X0, X1) - D) / B;
    let middle = middle.powf_scalar(1.0 / C);
    let bright = ((x.clone().clamp_min(X1) - G) / E).exp() - F;
    let is_bright = x.clone().detach().greater_elem(X1);
    let is_dark = x.clone().detach().lower_equal_elem(X0);
    let radiance = middle.mask_where(is_bright, bright);
    radiance.mask_where(is_dark, x / A)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    const RADIANCE: [f32; 6] = [1e-6, 1e-4, 0.02, 0.5, 3.0, 900.0];

    fn tensor(values: &[f32]) -> Tensor<4> {
        let device = Device::flex().autodiff();
        Tensor::<1>::from_floats(values, &device).reshape([1, 1, 2, 3])
    }

    fn host(tensor: Tensor<4>) -> Vec<f32> {
        tensor.into_data().try_to_vec().expect("f32")
    }

    /// The colours of [`RADIANCE`].
    fn colors() -> [f32; 6] {
        RADIANCE.map(|radiance| of_radiance(radiance) / of_radiance(PEAK))
    }

    #[test]
    fn radiance_comes_back_from_the_scalar_curve() {
        for (back, expected) in host(radiance(tensor(&colors()))).iter().zip(RADIANCE) {
            assert!(
                (back - expected).abs() < 1e-4 * expected,
                "{back} {expected}"
            );
        }
    }

    /// Compares with the slope between two values near each.
    #[test]
    fn the_slope_is_that_of_the_curve() {
        let x = tensor(&colors()).require_grad();
        let gradients = radiance(x.clone()).sum().backward();
        let slopes = host(x.grad(&gradients).expect("tracked"));
        let [low, high] = [0.999, 1.001].map(|factor| {
            let near = colors().map(|value| factor * value);
            host(radiance(tensor(&near)))
        });
        for (i, slope) in slopes.into_iter().enumerate() {
            let expected = (high[i] - low[i]) / (0.002 * colors()[i]);
            assert!(
                (slope - expected).abs() < 0.02 * expected,
                "{slope} {expected}"
            );
        }
    }
}
