//! The whole network (Fig. 3): fusion, encoders, latent, decoder. `forward` holds its forward pass.

use burn::module::Module;
use burn::tensor::Device;
use rand::Rng;

use crate::config::{LEVELS, ModelConfig, channels_of};
use crate::decoder::Decoder;
use crate::encoder::Encoder;
use crate::fusion::Fusion;
use crate::init::Init;
use crate::layers::ConvBlock;
use crate::ops::{self, Ops};
use crate::weights::{
    Builder, Stage, Weight, WeightSpec, Weights, WeightsError, collect, described, random, taken,
};

/// A denoising network of any variant and reading.
///
/// Field names are the keys of weight files: renaming one changes the file format.
#[derive(Module, Debug)]
pub struct Denoiser {
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
    #[module(skip)]
    ops: Ops,
}

impl ModelConfig {
    /// A new network, initialised from `rng` (Sec. 4.2). Equal generators give equal networks on
    /// all devices.
    ///
    /// `head_bias` is the flat image, in gamma space, at which a [`crate::Head::Grey`] starts. The
    /// best one has the smallest loss on the training set.
    ///
    /// # Panics
    /// If the configuration is invalid; see [`ModelConfig::validate`].
    pub fn init(&self, rng: &mut impl Rng, head_bias: [f32; 3], device: &Device) -> Denoiser {
        let mut source = random(rng);
        let mut builder = Builder::new(&mut source, device);
        Denoiser::build(&mut builder, self, head_bias)
            .expect("random values have the shape that was asked for")
    }

    /// The network with these weights.
    ///
    /// # Errors
    /// [`WeightsError`] if a weight is missing, has another shape or is not part of the network.
    pub fn load(&self, weights: &mut Weights, device: &Device) -> Result<Denoiser, WeightsError> {
        let denoiser = {
            let mut source = taken(weights);
            Denoiser::build(&mut Builder::new(&mut source, device), self, [0.0; 3])?
        };
        weights.all_taken()?;
        Ok(denoiser)
    }

    /// Every tensor of the network in the order of the modules, without its values.
    ///
    /// This is the one description of the network. Counts, costs, optimizer and exports look names,
    /// shapes, roles and stages up here.
    pub fn weight_specs(&self) -> Vec<WeightSpec> {
        let mut specs = Vec::new();
        let mut source = described(&mut specs);
        let device = Device::flex();
        Denoiser::build(&mut Builder::new(&mut source, &device), self, [0.0; 3])
            .expect("a description takes no values");
        drop(source);
        specs
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
        Ok(Denoiser {
            fusion,
            encoders,
            latent,
            decoder,
            config: *config,
            ops: ops::process_default(),
        })
    }

    /// The configuration of this network.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// The operations that this network asks for; see [`Ops`].
    pub fn ops(&self) -> Ops {
        self.ops
    }

    /// The network with other operations. A new network has [`ops::process_default`].
    pub fn with_ops(self, ops: Ops) -> Self {
        Denoiser { ops, ..self }
    }

    /// All weights and running statistics on the host, in the order of the modules.
    pub fn weights(&self) -> Vec<Weight> {
        // Burn merges an update of running statistics only at the next one; `valid` merges it, too.
        collect(&self.valid())
    }
}
