//! The fixtures as weights, tensors and expectations; gradients by name.

use std::collections::BTreeMap;
use std::path::PathBuf;

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use demc_model::{Denoiser, Head, ModelConfig, Reading, Variant, Weight, Weights};

use crate::tensors::{self, HostTensor};

const WIDTH: usize = 2;

/// One fixture file. Its tensors have PyTorch's names, after a prefix.
pub struct Fixture(BTreeMap<String, HostTensor>);

impl Fixture {
    /// The file `name`.safetensors.
    pub fn read(name: &str) -> Self {
        // A test copied to another machine finds them by this variable.
        let folder = std::env::var_os("DEMC_FIXTURES").map_or_else(
            || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("parity/fixtures"),
            PathBuf::from,
        );
        Fixture(tensors::read(&folder.join(format!("{name}.safetensors"))))
    }

    /// A tensor's values.
    pub fn values(&self, name: &str) -> &[f32] {
        let found = self
            .0
            .get(name)
            .unwrap_or_else(|| panic!("the fixture has no tensor {name}"));
        &found.data
    }

    /// A tensor on `device`.
    pub fn tensor(&self, name: &str, device: &Device) -> Tensor<4> {
        let data = TensorData::new(self.values(name).to_vec(), self.0[name].shape.clone());
        Tensor::from_data(data, device)
    }

    /// The tensors `prefix.0`, `prefix.1`, ... on `device`.
    pub fn list(&self, prefix: &str, device: &Device) -> Vec<Tensor<4>> {
        let names = (0..).map(|i| format!("{prefix}.{i}"));
        names
            .take_while(|name| self.0.contains_key(name))
            .map(|name| self.tensor(&name, device))
            .collect()
    }

    /// All tensors whose names begin with `prefix`, with Burn's names and without the prefix.
    pub fn group(&self, prefix: &str) -> Vec<Weight> {
        let weight = |(name, values): (&String, &HostTensor)| {
            let name = name
                .replace(".norm.weight", ".norm.gamma")
                .replace(".norm.bias", ".norm.beta");
            let (shape, data) = (values.shape.clone(), values.data.clone());
            Some(Weight {
                name: name.strip_prefix(prefix)?.to_string(),
                shape,
                data,
            })
        };
        self.0.iter().filter_map(weight).collect()
    }
}

/// The configuration of a fixture file.
pub fn config(variant: Variant, reading: Reading) -> ModelConfig {
    ModelConfig {
        variant,
        reading,
        width: WIDTH,
        ..ModelConfig::default()
    }
}

/// Name of a fixture file.
pub fn network_name(config: &ModelConfig) -> String {
    let end = match config.head {
        Head::Kernel => "-kernel",
        Head::Grey | Head::Xavier => "",
    };
    let (variant, reading) = (config.variant.spec().name, config.reading.spec().name);
    format!("{variant}-{reading}{end}")
}

/// The network of a fixture file, on `device`.
pub fn network(config: &ModelConfig, fixture: &Fixture, device: &Device) -> Denoiser {
    let mut weights = Weights::new(fixture.group("weight/"));
    config
        .load(&mut weights, device)
        .expect("the fixture has the weights of the network")
}

/// The values of a tensor.
pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor
        .into_data()
        .try_to_vec()
        .expect("float32 on every device here")
}

/// The gradients of a module's parameters, by their names.
pub fn gradients_by_name(
    module: &impl Module,
    gradients: &GradientsParams,
) -> BTreeMap<String, Vec<f32>> {
    struct GradientCollector<'a> {
        path: Vec<String>,
        gradients: &'a GradientsParams,
        found: BTreeMap<String, Vec<f32>>,
    }

    impl ModuleVisitor for GradientCollector<'_> {
        fn enter_module(&mut self, name: &str, _container_type: &str) {
            self.path.push(name.to_string());
        }

        fn exit_module(&mut self, _name: &str, _container_type: &str) {
            self.path.pop();
        }

        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(gradient) = self.gradients.get::<D>(param.id) {
                // The names of weights leave out a network's body.
                let body = if self.path[0] == "body" { 2 } else { 0 };
                self.found
                    .insert(self.path[body..].join("."), host(gradient));
            }
        }
    }

    let mut collector = GradientCollector {
        path: Vec::new(),
        gradients,
        found: BTreeMap::new(),
    };
    module.visit(&mut collector);
    collector.found
}

/// Whether a weight is a bias before a batch normalisation. Subtracting the mean cancels the bias,
/// so its gradient is zero except for float32 noise.
pub fn is_bias_before_norm(name: &str, reading: Reading) -> bool {
    let fused = ["fusion.blocks.1.conv.bias", "fusion.blocks.2.conv.bias"].contains(&name);
    let decoded = name == "latent.conv.bias" || name.ends_with("deconv.bias");
    fused || reading == Reading::Released && decoded
}
