//! The U-Net of Open Image Denoise 2 (OIDN): one encoder, one decoder, and the input as the last skip.
//!
//! Each convolution is 3x3, has a bias, and pads with zeros; a ReLU follows all but the last. An encoder
//! level ends with 2x2 max-pooling. A decoder level doubles the map below by repeating pixels, and
//! appends the encoder's map of that size, which for the full resolution is the network's input.
//!
//! The input has the noisy colour and up to two guides, albedo and normal, in OIDN's value ranges.

use burn::module::Module;
use burn::nn::conv::Conv2d;
use burn::tensor::{Device, Tensor};

use crate::config::{COLOR_CHANNELS, ModelConfig};
use crate::init::Init;
use crate::layers::{ConvStack, conv3x3};
use crate::ops::{Activation, Maps, Ops};
use crate::side_encoder::SideEncoder;
pub use crate::unet_size::{Guides, UNET_LEVELS, UnetSize, UnetSpec};
use crate::weights::{Builder, Stage, WeightsError};

/// The network. The names of its fields are the keys of weight files.
#[derive(Module, Debug)]
pub struct Unet {
    /// Convolutions of each level, from the full resolution down.
    pub encoder: Vec<ConvStack>,
    /// Convolutions at a sixteenth of the resolution.
    pub bottom: ConvStack,
    /// Convolutions of each level, from the deepest up.
    pub decoder: Vec<ConvStack>,
    /// The convolution to colour.
    pub head: Conv2d,
    /// The encoder of the features, if the variant has one.
    pub side: Option<SideEncoder>,
    #[module(skip)]
    guides: Guides,
}

impl Unet {
    pub(crate) fn build(b: &mut Builder, config: &ModelConfig) -> Result<Self, WeightsError> {
        let spec = config.size.spec();
        let mut channels = config.guides.channels();
        // Channels of the map that each decoder level appends.
        let mut skips = vec![channels];
        let encoder = b.list("encoder", UNET_LEVELS, |b, level| {
            b.enter(Stage::Encoder { encoder: 0, level });
            let outputs = spec.encoder[level];
            let built = ConvStack::build(b, channels, outputs)?;
            channels = outputs[outputs.len() - 1];
            skips.push(channels);
            Ok(built)
        })?;
        b.enter(Stage::Latent);
        let bottom = b.part("bottom", |b| ConvStack::build(b, channels, &spec.bottom))?;
        channels = spec.bottom[1];
        let decoder = b.list("decoder", UNET_LEVELS, |b, index| {
            let level = UNET_LEVELS - 1 - index;
            b.enter(Stage::Decoder { level });
            let outputs = &spec.decoder[index];
            let built = ConvStack::build(b, channels + skips[level], outputs)?;
            channels = outputs[1];
            Ok(built)
        })?;
        b.enter(Stage::Head { level: 0 });
        let head = b.part("head", |b| {
            conv3x3(
                b,
                [channels, COLOR_CHANNELS],
                Init::Xavier(1.0),
                Init::Zeros,
            )
        })?;
        let mut decoded = spec.decoder.map(|outputs| outputs[1]);
        decoded.reverse();
        let input = config.variant.spec().side;
        let side = input
            .map(|input| {
                b.part("side", |b| {
                    SideEncoder::build(b, input, config.width, &decoded)
                })
            })
            .transpose()?;
        Ok(Unet {
            encoder,
            bottom,
            decoder,
            head,
            side,
            guides: config.guides,
        })
    }

    pub(crate) fn device(&self) -> Device {
        self.head.weight.val().device()
    }

    /// What the network takes beside the colour.
    pub fn guides(&self) -> Guides {
        self.guides
    }

    /// The detail map of the features, or `None` for a network without fusion.
    ///
    /// # Shapes
    /// `[B, 12, H, W]` to `[B, 3, H, W]`, not negative.
    pub fn detail_map(&self, features: Tensor<4>, ops: Ops) -> Option<Tensor<4>> {
        let fusion = self.side.as_ref()?.fusion.as_ref()?;
        Some(fusion.forward(Maps::from_nchw(features, ops)).into_nchw())
    }

    /// Denoises colour with guides, both in OIDN's value ranges.
    ///
    /// # Shapes
    /// `color` `[B, 3, H, W]`; `features` `[B, 12, H, W]`, of which the guides count, with a second encoder
    /// all; H and W multiples of 16. Returns the shape of `color`, not negative.
    pub fn forward(&self, color: Tensor<4>, features: Tensor<4>, ops: Ops) -> Tensor<4> {
        let side = self
            .side
            .as_ref()
            .map(|side| (side, side.forward(Maps::from_nchw(features.clone(), ops))));
        let mut inputs = vec![color];
        for first in self.guides.first_channels() {
            inputs.push(features.clone().narrow(1, *first, COLOR_CHANNELS));
        }
        let mut x = Maps::from_nchw(Tensor::cat(inputs, 1), ops);
        let mut skips = Vec::with_capacity(UNET_LEVELS);
        for level in &self.encoder {
            skips.push(x.clone());
            x = level.forward(x).max_pool();
        }
        x = self.bottom.forward(x);
        for (index, level) in self.decoder.iter().enumerate() {
            let skip = skips.pop().expect("a skip for each level");
            x = level.forward(x.double_and_append(skip));
            if let Some((side, maps)) = &side {
                x = side.fuse(index, x, maps[index].clone());
            }
        }
        x.conv3x3(&self.head, Activation::Relu).into_nchw()
    }
}
