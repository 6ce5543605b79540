//! A network of any variant. `forward` holds its forward pass.

use burn::module::{Module, ModuleVisitor};
use burn::tensor::Device;
use rand::Rng;

use crate::config::{ModelConfig, Variant};
use crate::dual_encoder::DualEncoder;
use crate::kpcn::Kpcn;
use crate::ops::{self, Ops};
use crate::unet::Unet;
use crate::weights::{
    Builder, Weight, WeightCollector, WeightSpec, Weights, WeightsError, described, random, taken,
};

/// A denoising network of any variant and reading.
#[derive(Module, Debug)]
pub struct Denoiser {
    /// The network itself.
    pub body: Body,
    #[module(skip)]
    config: ModelConfig,
    #[module(skip)]
    ops: Ops,
}

/// The network of a variant.
///
/// The names of its fields are the keys of weight files: renaming one changes the file format.
#[derive(Module, Debug)]
#[allow(clippy::large_enum_variant, reason = "there is one per process")]
pub enum Body {
    /// Encoders and a decoder.
    DualEncoder(DualEncoder),
    /// The networks of KPCN.
    Kpcn(Kpcn),
    /// The U-Net of Open Image Denoise.
    Unet(Unet),
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
        let body = match config.variant {
            Variant::Kpcn => Body::Kpcn(Kpcn::build(b, config.width)?),
            variant if variant.is_unet() => Body::Unet(Unet::build(b, config)?),
            _ => Body::DualEncoder(DualEncoder::build(b, config, head_bias)?),
        };
        Ok(Denoiser {
            body,
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

    /// The encoders and the decoder of the paper's networks; `None` for others.
    pub fn dual_encoder(&self) -> Option<&DualEncoder> {
        match &self.body {
            Body::DualEncoder(network) => Some(network),
            Body::Kpcn(_) | Body::Unet(_) => None,
        }
    }

    /// Whether the network filters layers of the image, too: whether its head predicts kernels.
    pub fn filters_layers(&self) -> bool {
        let network = self.dual_encoder();
        network.is_some_and(|network| network.decoder.head.is_none())
    }

    /// Visits all parameters. Their paths are the names of the weights, without the body's.
    pub fn visit_named(&self, visitor: &mut impl ModuleVisitor) {
        match &self.body {
            Body::DualEncoder(network) => network.visit(visitor),
            Body::Kpcn(networks) => networks.visit(visitor),
            Body::Unet(network) => network.visit(visitor),
        }
    }

    /// All weights and running statistics on the host, in the order of the modules.
    pub fn weights(&self) -> Vec<Weight> {
        // Burn merges an update of running statistics only at the next one; `valid` merges it, too.
        let mut collector = WeightCollector::default();
        self.valid().visit_named(&mut collector);
        collector.weights
    }
}
