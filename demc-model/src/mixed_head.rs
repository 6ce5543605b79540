//! The mixed head of a U-Net: its own image and the noisy colour filtered with predicted kernels, blended
//! by a gate.
//!
//! - `direct`: the U-Net's image.
//! - `filtered`: the image of a [kernel head](crate::kernel_head) on the decoder's maps.
//! - The output is `(1 - g) direct + g filtered`, all in the network's space. g is the sigmoid of a 1x1
//!   convolution of the decoder's last map.
//!
//! The gate starts at [`GATE_BIAS`], so the network starts near the U-Net's image.

use burn::module::Module;
use burn::nn::conv::Conv2d;

use crate::init::{GREY_HEAD_SCALE, Init};
use crate::kernel_head;
use crate::layers::conv;
use crate::ops::Maps;
use crate::weights::{Builder, Stage, WeightsError};

/// Initial bias of the gate: 12 % of the filtered image. From 50 %, the gate closed within 500 steps.
pub const GATE_BIAS: f32 = -2.0;

/// The convolutions to kernels and to the gate.
#[derive(Module, Debug)]
pub struct MixedHead {
    /// The convolutions to kernels, deepest level first.
    pub kernels: Vec<Conv2d>,
    /// The convolution to the gate.
    pub gate: Conv2d,
}

impl MixedHead {
    /// `channels`: those of the decoder's levels, from the full resolution down.
    pub(crate) fn build(b: &mut Builder, channels: &[usize]) -> Result<Self, WeightsError> {
        let kernels = kernel_head::build(b, channels)?;
        b.enter(Stage::Head { level: 0 });
        let gate = b.part("gate", |b| {
            let weight = Init::Xavier(GREY_HEAD_SCALE);
            conv(b, [channels[0], 1], 1, weight, Init::Filled(GATE_BIAS))
        })?;
        Ok(MixedHead { kernels, gate })
    }

    /// The blended image, and the layers filtered with the kernels.
    ///
    /// # Shapes
    /// `direct` and the noisy `color` `[B, 3, H, W]` in the network's space; `decoded`: the decoder's maps,
    /// deepest first; layers `[L, 3, H, W]` in linear light, for B = 1. Returns the shapes of `direct` and
    /// the layers.
    pub fn forward(
        &self,
        direct: Maps,
        decoded: Vec<Maps>,
        color: Maps,
        layers: Option<Maps>,
    ) -> (Maps, Option<Maps>) {
        let last = decoded.last().expect("a decoder has levels").clone();
        let gate = last.conv1x1(&self.gate).sigmoid();
        let color = color.pu_radiance();
        let (filtered, layers) = kernel_head::filtered(&self.kernels, decoded, color, layers);
        (direct.mix(filtered.pu_color(), gate), layers)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Tensor};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use crate::unet::UnetSize;
    use crate::{Head, ModelConfig, Ops, Variant, Weights};

    /// The image of a small network with this bias of the gate, for a flat colour.
    fn image(bias: f32, head: Head) -> Vec<f32> {
        let config = ModelConfig {
            variant: Variant::Unet,
            size: UnetSize::Small,
            head,
            ..ModelConfig::default()
        };
        let device = Device::flex();
        let mut weights = config
            .init(&mut ChaCha8Rng::seed_from_u64(2), [0.0; 3], &device)
            .weights();
        let gate = weights.iter_mut().find(|w| w.name == "mixed.gate.bias");
        gate.into_iter().for_each(|gate| gate.data[0] = bias);
        let network = config.load(&mut Weights::new(weights), &device);
        let images = [3, 12].map(|channels| Tensor::full([1, channels, 16, 16], 0.4, &device));
        let [color, features] = images;
        let network = network.expect("its own weights").with_ops(Ops::Burn);
        let out = network.forward(color, features).into_data();
        out.try_to_vec().expect("float32")
    }

    #[test]
    fn a_closed_gate_leaves_the_direct_image_and_an_open_one_the_filtered() {
        assert_eq!(image(-200.0, Head::Mixed), image(0.0, Head::Grey));
        // Kernels keep a flat image.
        for value in image(200.0, Head::Mixed) {
            assert!((value - 0.4).abs() < 1e-5, "{value}");
        }
    }
}
