//! The network's output in gamma space, where the losses are defined, with gradients.

use burn::tensor::Tensor;
use demc_data::Transfer;
use demc_model::kernel_head::DARKEST;
use demc_model::pu;

/// An output, compressed by `transfer`, in gamma space. Below `DARKEST` it has no gradient under
/// [`Transfer::Pu`].
///
/// # Shapes
/// Any to the same.
pub fn in_gamma(out: Tensor<4>, transfer: Transfer, gamma: f32) -> Tensor<4> {
    match transfer {
        Transfer::Gamma => out,
        Transfer::Pu => pu::radiance(out)
            .clamp_min(DARKEST)
            .powf_scalar(1.0 / gamma),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn the_output_comes_back_from_the_curve_with_its_slope() {
        let device = Device::flex().autodiff();
        let radiance = [1e-6, 1e-4, 0.02, 0.5, 3.0, 900.0];
        let compress = |radiance: &[f32]| {
            let mut color = radiance.to_vec();
            Transfer::Pu.compress(&mut color, 2.2);
            color
        };
        let tensor =
            |values: &[f32]| Tensor::<1>::from_floats(values, &device).reshape([1, 1, 2, 3]);
        let out: Tensor<4> = tensor(&compress(&radiance)).require_grad();
        let found = in_gamma(out.clone(), Transfer::Pu, 2.2);
        let gradients = found.clone().sum().backward();
        let slopes: Vec<f32> = out
            .grad(&gradients)
            .expect("tracked")
            .into_data()
            .try_to_vec()
            .expect("f32");
        let found: Vec<f32> = found.into_data().try_to_vec().expect("f32");
        // The slope from two radiances near each.
        let [below, above] = [0.999, 1.001].map(|f| radiance.map(|radiance| f * radiance));
        let [x0, x1] = [below, above].map(|radiance| compress(&radiance));
        for i in 0..radiance.len() {
            let expected = radiance[i].powf(1.0 / 2.2);
            assert!(
                (found[i] - expected).abs() < 1e-4 * expected,
                "{} {expected}",
                found[i]
            );
            let rise = above[i].powf(1.0 / 2.2) - below[i].powf(1.0 / 2.2);
            let slope = rise / (x1[i] - x0[i]);
            assert!(
                (slopes[i] - slope).abs() < 0.02 * slope,
                "{} {slope}",
                slopes[i]
            );
        }
    }
}
