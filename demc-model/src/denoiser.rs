//! The whole network (Fig. 3): fusion, encoders, latent, decoder.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::{COLOR_CHANNELS, DOWNSAMPLING, FEATURE_CHANNELS, Input, LEVELS, ModelConfig};
use crate::decoder::Decoder;
use crate::encoder::{Encoded, Encoder};
use crate::fusion::Fusion;
use crate::inference;
use crate::init::Init;
use crate::layers::ConvBlock;
use crate::ops::{self, Maps, Ops};
use crate::weights::{Builder, Weight, Weights, WeightsError, collect, drawn, taken};

/// A denoising network of any variant and reading.
///
/// Field names are the keys of weight files: renaming one changes the file format.
#[derive(Module, Debug)]
pub struct Denoiser {
    /// The feature fusion sub-network, where the variant has one.
    pub fusion: Option<Fusion>,
    /// The encoders in the order of the table of variants; the last one feeds the latent.
    pub encoders: Vec<Encoder>,
    /// The latent representation's convolution.
    pub latent: ConvBlock,
    /// The decoder with the skip fusions and the output head.
    pub decoder: Decoder,
    #[module(skip)]
    config: ModelConfig,
    #[module(skip)]
    ops: Ops,
}

impl ModelConfig {
    /// A new network with weights drawn from `rng` (Sec. 4.2), the same for the same generator on every device.
    ///
    /// `head_bias` is the flat image where a [`crate::Head::Grey`] starts, in gamma space: best the one with the least
    /// loss on the training set.
    ///
    /// # Panics
    /// Where the configuration is invalid; see [`ModelConfig::validate`].
    pub fn init(&self, rng: &mut impl Rng, head_bias: [f32; 3], device: &Device) -> Denoiser {
        let mut source = drawn(rng);
        let mut builder = Builder::new(&mut source, device);
        Denoiser::build(&mut builder, self, head_bias)
            .expect("a drawn weight has the shape it was asked for")
    }

    /// The network that these weights make.
    ///
    /// # Errors
    /// A weight that is missing, has another shape or does not belong to the network, by name.
    pub fn load(&self, weights: &mut Weights, device: &Device) -> Result<Denoiser, WeightsError> {
        let denoiser = {
            let mut source = taken(weights);
            Denoiser::build(&mut Builder::new(&mut source, device), self, [0.0; 3])?
        };
        weights.all_taken()?;
        Ok(denoiser)
    }
}

impl Denoiser {
    pub(crate) fn build(
        b: &mut Builder,
        config: &ModelConfig,
        head_bias: [f32; 3],
    ) -> Result<Self, WeightsError> {
        let spec = config.variant.spec();
        let deepest = config.level_channels()[LEVELS - 1];
        let fusion = match spec.has_fusion() {
            true => Some(b.part("fusion", |b| Fusion::build(b, config.width, config.detail))?),
            false => None,
        };
        let encoders = b.list("encoders", spec.encoders.len(), |b, e| {
            let input = spec.encoders[e].iter().map(|input| input.channels()).sum();
            Encoder::build(b, config, input, e + 1 == spec.encoders.len())
        })?;
        let normalised = config.reading.spec().normalised_decoder;
        let latent = b.part("latent", |b| {
            ConvBlock::build(b, [deepest, deepest], normalised, Init::Zeros)
        })?;
        let decoder = b.part("decoder", |b| Decoder::build(b, config, head_bias))?;
        Ok(Denoiser {
            fusion,
            encoders,
            latent,
            decoder,
            config: *config,
            ops: ops::process_default(),
        })
    }

    /// What this network is.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// The operations that this network asks for.
    pub fn ops(&self) -> Ops {
        self.ops
    }

    /// The same network on other operations; new ones ask for [`ops::process_default`].
    pub fn with_ops(self, ops: Ops) -> Self {
        Denoiser { ops, ..self }
    }

    /// Denoises gamma-compressed colour with the help of Z-scored features.
    ///
    /// Batch normalisation uses the batch's statistics on a device with autodiff, the running ones elsewhere.
    ///
    /// # Shapes
    /// `color_gamma` `[B, 3, H, W]`, `features_z` `[B, 12, H, W]`, H and W multiples of 32; returns `[B, 3, H, W]` in gamma
    /// space, not negative.
    ///
    /// # Panics
    /// Where the shapes are others.
    pub fn forward(&self, color_gamma: Tensor<4>, features_z: Tensor<4>) -> Tensor<4> {
        assert_shapes(color_gamma.dims(), features_z.dims());
        if inference::applies(self, &color_gamma) {
            return inference::forward(self, color_gamma, features_z);
        }
        let color_gamma = Maps::from_nchw(color_gamma, self.ops);
        let features_z = Maps::from_nchw(features_z, self.ops);
        let fusion = self.fusion.as_ref();
        let detail_map = fusion.map(|fusion| fusion.forward(features_z.clone()));
        let image = |input: &Input| match input {
            Input::Color => color_gamma.clone(),
            Input::Features => features_z.clone(),
            Input::DetailMap => detail_map
                .clone()
                .expect("a variant whose encoder eats the detail map has a fusion"),
        };
        let inputs = self.config.variant.spec().encoders;
        let mut encoded: Vec<Encoded> = self
            .encoders
            .iter()
            .zip(inputs)
            .map(|(encoder, inputs)| encoder.forward(Maps::cat(inputs.iter().map(image).collect())))
            .collect();
        let bottom = encoded
            .last_mut()
            .and_then(|last| last.bottom.take())
            .expect("the last encoder feeds the latent");
        self.decoder
            .forward(self.latent.forward(bottom), skips_by_level(encoded))
            .into_nchw()
    }

    /// The detail map (Fig. 2 e) of Z-scored features; `None` for a variant without fusion.
    ///
    /// # Shapes
    /// `[B, 12, H, W]` to `[B, 3, H, W]`, not negative.
    pub fn detail_map(&self, features_z: Tensor<4>) -> Option<Tensor<4>> {
        self.fusion.as_ref().map(|fusion| {
            fusion
                .forward(Maps::from_nchw(features_z, self.ops))
                .into_nchw()
        })
    }

    /// All weights on the host, in the order of the fields, the running statistics of batch normalisation among them.
    pub fn weights(&self) -> Vec<Weight> {
        // `valid` also brings the running statistics up to date: Burn merges an update only at the next one.
        collect(&self.valid())
    }

    /// Number of trainable values: all weights but the running statistics.
    pub fn parameter_count(&self) -> usize {
        let weights = self.weights();
        weights
            .iter()
            .filter(|weight| weight.is_trainable())
            .map(|weight| weight.data.len())
            .sum()
    }
}

impl Weight {
    /// Whether the optimizer changes it: false for the running statistics of batch normalisation.
    pub fn is_trainable(&self) -> bool {
        !self.name.contains("norm.running_")
    }
}

/// The encoders' skips regrouped for the decoder: a list a level, deepest first, of one entry an encoder.
fn skips_by_level(encoded: Vec<Encoded>) -> Vec<Vec<Maps>> {
    let mut encoders: Vec<_> = encoded
        .into_iter()
        .map(|e| e.skips.into_iter().rev())
        .collect();
    (0..LEVELS)
        .map(|_| encoders.iter_mut().filter_map(Iterator::next).collect())
        .collect()
}

fn assert_shapes([batch, colors, height, width]: [usize; 4], features: [usize; 4]) {
    assert_eq!(
        colors, COLOR_CHANNELS,
        "color_gamma has {COLOR_CHANNELS} channels"
    );
    assert_eq!(
        features,
        [batch, FEATURE_CHANNELS, height, width],
        "features_z fits color_gamma"
    );
    assert!(
        height > 0 && width > 0 && height % DOWNSAMPLING == 0 && width % DOWNSAMPLING == 0,
        "{height} x {width}: height and width are multiples of {DOWNSAMPLING}"
    );
}
