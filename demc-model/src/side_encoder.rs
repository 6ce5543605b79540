//! The encoder of the features beside a U-Net: the paper's second encoder on another trunk.
//!
//! Its input are the twelve features, or the detail map that the fusion sub-network makes of them (Sec. 3.2).
//! Four levels have two 3x3 convolutions with ReLU each; between them is 2x2 max-pooling. A 1x1 convolution adds the map of
//! each level to the decoder's map of that size.
//!
//! A fusion starts as the decoder's map alone, so the network starts as the U-Net without this encoder.

use burn::module::Module;
use burn::nn::conv::Conv2d;

use crate::config::{Detail, Input};
use crate::fusion::Fusion;
use crate::init::Init;
use crate::layers::{ConvStack, conv};
use crate::ops::{Activation, Maps};
use crate::unet_size::UNET_LEVELS;
use crate::weights::{Builder, Stage, WeightsError};

/// Channels of each level as multiples of the width, from the full resolution down.
pub(crate) const LEVEL_WIDTHS: [usize; UNET_LEVELS] = [1, 2, 4, 4];

/// The encoder and its fusions.
#[derive(Module, Debug)]
pub struct SideEncoder {
    /// The feature fusion sub-network, if the encoder takes the detail map.
    pub fusion: Option<Fusion>,
    /// Convolutions of each level, from the full resolution down.
    pub levels: Vec<ConvStack>,
    /// The 1x1 convolutions of `[decoder | encoder]`, deepest level first.
    pub fuses: Vec<Conv2d>,
}

impl SideEncoder {
    /// `decoder`: the channels of the decoder's levels, from the full resolution down.
    pub(crate) fn build(
        b: &mut Builder,
        input: Input,
        width: usize,
        decoder: &[usize; UNET_LEVELS],
    ) -> Result<Self, WeightsError> {
        let fusion = if input == Input::DetailMap {
            b.enter(Stage::Fusion);
            Some(b.part("fusion", |b| Fusion::build(b, width, Detail::Open))?)
        } else {
            None
        };
        let channels = LEVEL_WIDTHS.map(|factor| factor * width);
        let mut inputs = input.channels();
        let levels = b.list("levels", UNET_LEVELS, |b, level| {
            b.enter(Stage::Encoder { encoder: 1, level });
            let built = ConvStack::build(b, inputs, &[channels[level]; 2])?;
            inputs = channels[level];
            Ok(built)
        })?;
        let fuses = b.list("fuses", UNET_LEVELS, |b, index| {
            let level = UNET_LEVELS - 1 - index;
            b.enter(Stage::Decoder { level });
            let [input, output] = [decoder[level] + channels[level], decoder[level]];
            conv(b, [input, output], 1, Init::IdentityFirst, Init::Zeros)
        })?;
        Ok(SideEncoder {
            fusion,
            levels,
            fuses,
        })
    }

    /// The map of each level, deepest first.
    ///
    /// # Shapes
    /// `[B, 12, H, W]`, H and W multiples of 8.
    pub fn forward(&self, features: Maps) -> Vec<Maps> {
        let mut x = match &self.fusion {
            Some(fusion) => fusion.forward(features),
            None => features,
        };
        let mut maps = Vec::with_capacity(UNET_LEVELS);
        for (level, module) in self.levels.iter().enumerate() {
            if level > 0 {
                x = x.max_pool();
            }
            x = module.forward(x);
            maps.push(x.clone());
        }
        maps.reverse();
        maps
    }

    /// A decoder's map with that of this encoder; `index` counts from the deepest level.
    pub fn fuse(&self, index: usize, decoded: Maps, side: Maps) -> Maps {
        Maps::fuse(vec![decoded, side], &self.fuses[index], Activation::Relu)
    }
}
