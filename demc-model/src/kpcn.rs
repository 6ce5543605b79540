//! KPCN (Bako et al. 2017): the kernel-predicting networks that the paper compares with.
//!
//! One network denoises diffuse light, divided by the albedo; the other denoises the logarithm of
//! specular light. Each is nine 5x5 convolutions, which give 441 logits per pixel. Their softmax is
//! the 21x21 kernel of that pixel.
//!
//! A network takes 34 channels as input. Its light, the normal, and the albedo have three each, the
//! depth has one. The differences of these to the pixel on the left and to the one above follow, and
//! one variance of each.
//!
//! Ours, since Bako et al. are silent or crop their patches: convolutions pad with zeros, kernels
//! replicate the border.

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::tensor::Tensor;

use crate::config::COLOR_CHANNELS;
use crate::init::Init;
use crate::kernel_head::DARKEST;
use crate::layers::conv;
use crate::ops::{Activation, Maps, Ops, mean_per_image};
use crate::weights::{Builder, Stage, WeightsError};

/// Convolutions of a network.
pub const LAYERS: usize = 9;

/// Logits of a 21x21 kernel.
pub const KERNEL_LOGITS: usize = 21 * 21;

/// Channels that a network takes as input.
pub const INPUTS: usize = 34;

/// Side of the convolutions in pixels.
const SIDE: usize = 5;

/// Channels of the features without differences and variances: normal, albedo, depth.
pub const SURFACE: [usize; 3] = [3, 3, 1];

/// Index of the first variance among the features: those of diffuse and specular light, normal, albedo,
/// and depth.
pub const VARIANCES: usize = 7;

/// The networks for diffuse and for specular light.
#[derive(Module, Debug)]
pub struct Kpcn {
    /// The network for diffuse light, divided by the albedo.
    pub diffuse: KernelNetwork,
    /// The network for the logarithm of specular light.
    pub specular: KernelNetwork,
}

/// A network that predicts kernels.
#[derive(Module, Debug)]
pub struct KernelNetwork {
    /// The 5x5 convolutions, with bias; a ReLU follows all but the last.
    pub layers: Vec<Conv2d>,
}

impl Kpcn {
    pub(crate) fn build(b: &mut Builder, width: usize) -> Result<Self, WeightsError> {
        let mut network = |name, encoder| b.part(name, |b| KernelNetwork::build(b, width, encoder));
        Ok(Kpcn {
            diffuse: network("diffuse", 0)?,
            specular: network("specular", 1)?,
        })
    }

    /// Filters both parts of the light with predicted kernels. The light has no gradient.
    ///
    /// # Shapes
    /// `color` `[B, 6, H, W]`: diffuse light, divided by the albedo, and the logarithm of specular
    /// light. `features` `[B, 12, H, W]`: normal, albedo, and depth; the variances of diffuse and
    /// specular light, normal, albedo, and depth. Returns the shape of `color`.
    pub fn forward(&self, color: Tensor<4>, features: Tensor<4>, ops: Ops) -> Tensor<4> {
        let plane = |first, count| features.clone().narrow(1, first, count);
        let mut surface = Vec::new();
        let mut first = 0;
        for (index, channels) in SURFACE.into_iter().enumerate() {
            surface.extend(with_differences(plane(first, channels)));
            surface.push(plane(VARIANCES + 2 + index, 1));
            first += channels;
        }
        let parts = [&self.diffuse, &self.specular].into_iter().enumerate();
        let filtered = parts.map(|(part, network)| {
            let light = color
                .clone()
                .narrow(1, part * COLOR_CHANNELS, COLOR_CHANNELS);
            let mut inputs = with_differences(light.clone()).to_vec();
            inputs.push(plane(VARIANCES + part, 1));
            inputs.extend(surface.iter().cloned());
            let logits = network.forward(Maps::from_nchw(Tensor::cat(inputs, 1), ops));
            Maps::from_nchw(light, ops).filter(logits).into_nchw()
        });
        Tensor::cat(filtered.collect(), 1)
    }
}

impl KernelNetwork {
    fn build(b: &mut Builder, width: usize, encoder: usize) -> Result<Self, WeightsError> {
        let layers = b.list("layers", LAYERS, |b, layer| {
            let is_last = layer + 1 == LAYERS;
            b.enter(if is_last {
                Stage::Head { level: 0 }
            } else {
                Stage::Encoder { encoder, level: 0 }
            });
            let inputs = if layer == 0 { INPUTS } else { width };
            let outputs = if is_last { KERNEL_LOGITS } else { width };
            conv(b, [inputs, outputs], SIDE, Init::Xavier(1.0), Init::Zeros)
        })?;
        Ok(KernelNetwork { layers })
    }

    /// The logits of each pixel's kernel.
    ///
    /// # Shapes
    /// `[B, 34, H, W]` to `[B, 441, H, W]`.
    pub fn forward(&self, inputs: Maps) -> Maps {
        let (last, hidden) = self.layers.split_last().expect("nine layers");
        let maps = hidden
            .iter()
            .fold(inputs, |maps, conv| maps.conv5x5(conv, Activation::Relu));
        maps.conv5x5(last, Activation::None)
    }
}

/// The sum of both networks' losses for each image: mean absolute errors in their spaces.
///
/// # Shapes
/// Two `[B, 6, H, W]` to `[B]`.
pub fn separate_losses(light: Tensor<4>, reference: Tensor<4>) -> Tensor<1> {
    mean_per_image((light - reference).abs()).mul_scalar(2.0)
}

/// Both parts of the light together, in gamma space.
///
/// # Shapes
/// `light` `[B, 6, H, W]` in the networks' spaces, `divisor` of diffuse light `[B, 3, H, W]`, to
/// `[B, 3, H, W]`.
pub fn joined_gamma(light: Tensor<4>, divisor: Tensor<4>, gamma: f32) -> Tensor<4> {
    let part = |first| light.clone().narrow(1, first, COLOR_CHANNELS);
    let radiance = part(0) * divisor + part(COLOR_CHANNELS).exp().sub_scalar(1.0);
    radiance.clamp_min(DARKEST).powf_scalar(1.0 / gamma)
}

/// The planes, their differences to the pixel on the left, and those to the pixel above; 0 at the border.
fn with_differences(planes: Tensor<4>) -> [Tensor<4>; 3] {
    let difference = |axis: usize| {
        let length = planes.dims()[axis];
        let first = planes.clone().narrow(axis, 0, 1);
        if length == 1 {
            return first.zeros_like();
        }
        let before = planes.clone().narrow(axis, 0, length - 1);
        planes.clone() - Tensor::cat(vec![first, before], axis)
    };
    let [across, down] = [3, 2].map(difference);
    [planes, across, down]
}
