//! The networks of the paper (Fig. 3): fusion, encoders, latent, decoder.

use burn::module::Module;
use burn::tensor::{Device, Tensor};

use crate::config::{Input, LEVELS, ModelConfig, channels_of};
use crate::decoder::Decoder;
use crate::encoder::{Encoder, EncoderOutput};
use crate::fusion::Fusion;
use crate::init::Init;
use crate::layers::ConvBlock;
use crate::ops::{Maps, Ops};
use crate::weights::{Builder, Stage, WeightsError};

/// A network of encoders and a decoder, of any reading: every variant but KPCN.
#[derive(Module, Debug)]
pub struct DualEncoder {
    /// The feature fusion sub-network, if the variant has one.
    pub fusion: Option<Fusion>,
    /// The encoders in the order of the table of variants; the last one feeds the latent.
    pub encoders: Vec<Encoder>,
    /// The latent representation's convolution.
    pub latent: ConvBlock,
    /// The decoder with the skip fusions and the output head.
    pub decoder: Decoder,
    #[module(skip)]
    config: ModelConfig,
}

impl DualEncoder {
    /// A network; a grey head starts at `head_bias`, a flat image in gamma space.
    pub(crate) fn build(
        b: &mut Builder,
        config: &ModelConfig,
        head_bias: [f32; 3],
    ) -> Result<Self, WeightsError> {
        let spec = config.variant.spec();
        let deepest = config.level_channels()[LEVELS - 1];
        let fusion = if spec.has_fusion() {
            Some(
                b.enter(Stage::Fusion)
                    .part("fusion", |b| Fusion::build(b, config.width, config.detail))?,
            )
        } else {
            None
        };
        let encoders = b.list("encoders", spec.encoders.len(), |b, e| {
            Encoder::build(b, config, e, channels_of(spec.encoders[e]))
        })?;
        let normalised = config.reading.spec().normalised_decoder;
        let latent = b.enter(Stage::Latent).part("latent", |b| {
            ConvBlock::build(b, [deepest, deepest], normalised, Init::Zeros)
        })?;
        let decoder = b.part("decoder", |b| Decoder::build(b, config, head_bias))?;
        Ok(DualEncoder {
            fusion,
            encoders,
            latent,
            decoder,
            config: *config,
        })
    }

    /// The configuration of this network.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Denoises colour, and layers with the kernels of a kernel head.
    ///
    /// # Shapes
    /// As [`Denoiser::forward_observed`](crate::Denoiser::forward_observed).
    pub(crate) fn forward(
        &self,
        [color, features]: [Tensor<4>; 2],
        layers: Option<Tensor<4>>,
        ops: Ops,
    ) -> (Tensor<4>, Option<Tensor<4>>) {
        let layers = layers.map(|layers| Maps::from_nchw(layers, ops));
        let [color, features] = [color, features].map(|images| Maps::from_nchw(images, ops));
        let fusion = self.fusion.as_ref();
        let detail_map = fusion.map(|fusion| fusion.forward(features.clone()));
        let image = |input: &Input| match input {
            Input::Color => color.clone(),
            Input::Features => features.clone(),
            Input::DetailMap => detail_map
                .clone()
                .expect("a variant with a detail map has a fusion"),
        };
        let inputs = self.config().variant.spec().encoders;
        let mut encoded: Vec<EncoderOutput> = self
            .encoders
            .iter()
            .zip(inputs)
            .map(|(encoder, inputs)| encoder.forward(Maps::cat(inputs.iter().map(image).collect())))
            .collect();
        let bottom = encoded
            .last_mut()
            .and_then(|last| last.bottom.take())
            .expect("the last encoder feeds the latent");
        let (color, layers) = self.decoder.forward(
            self.latent.forward(bottom),
            skips_by_level(encoded),
            color,
            layers,
        );
        (color.into_nchw(), layers.map(Maps::into_nchw))
    }

    /// The detail map (Fig. 2 e) of Z-scored features, or `None` for a variant without fusion.
    ///
    /// # Shapes
    /// `[B, 12, H, W]` to `[B, 3, H, W]`, not negative.
    pub fn detail_map(&self, features_z: Tensor<4>, ops: Ops) -> Option<Tensor<4>> {
        let features = Maps::from_nchw(features_z, ops);
        let fusion = self.fusion.as_ref();
        fusion.map(|fusion| fusion.forward(features).into_nchw())
    }

    /// The device of the weights.
    pub(crate) fn device(&self) -> Device {
        self.latent.conv.weight.val().device()
    }
}

/// The skips by level for the decoder: one list per level, deepest first, with one entry per
/// encoder.
fn skips_by_level(encoded: Vec<EncoderOutput>) -> Vec<Vec<Maps>> {
    let mut encoders: Vec<_> = encoded
        .into_iter()
        .map(|e| e.skips.into_iter().rev())
        .collect();
    (0..LEVELS)
        .map(|_| encoders.iter_mut().filter_map(Iterator::next).collect())
        .collect()
}
