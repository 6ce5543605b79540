//! Named weights of a network: how modules are described, built, saved and loaded.
//!
//! A module asks a [`Builder`] for each of its tensors by name, role and shape, in a fixed order.
//! The builder initialises the values randomly ([`crate::init`]), takes them from [`Weights`], or
//! only describes the tensor as a [`WeightSpec`]. All three share one description of the network.
//! So a load is strict, and parameter ids are the same in every process: Adam's state needs that
//! after a resume.

use std::collections::BTreeMap;

use burn::module::{ModuleVisitor, Param, ParamId, RunningState};
use burn::tensor::{Device, Tensor, TensorData};
use thiserror::Error;

use crate::init::Init;

/// One tensor of a network, on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct Weight {
    /// Path of module fields, such as `decoder.levels.0.deconv.weight`.
    pub name: String,
    /// Axes, outermost first: convolutions `[out, in, h, w]`, deconvolutions `[in, out, h, w]`.
    pub shape: Vec<usize>,
    /// Values, row-major.
    pub data: Vec<f32>,
}

/// The kind of value that a tensor holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Role {
    /// Kernel of a convolution, `[out, in, h, w]`.
    Convolution,
    /// Kernel of a deconvolution with stride 2, `[in, out, h, w]`.
    Deconvolution,
    /// Bias of a convolution or deconvolution, `[out]`.
    Bias,
    /// Scale of a batch normalisation, `[channels]`.
    NormScale,
    /// Shift of a batch normalisation, `[channels]`.
    NormShift,
    /// Running mean of a batch normalisation, `[channels]`.
    RunningMean,
    /// Running variance of a batch normalisation, `[channels]`.
    RunningVariance,
}

impl Role {
    /// Whether the optimizer changes the tensor: false for running statistics.
    pub fn is_trainable(self) -> bool {
        !matches!(self, Role::RunningMean | Role::RunningVariance)
    }

    /// Whether the tensor belongs to a batch normalisation.
    pub fn is_norm(self) -> bool {
        matches!(self, Role::NormScale | Role::NormShift) || !self.is_trainable()
    }
}

/// The part of the network (Fig. 3) that a tensor belongs to. Levels count from the full resolution
/// (0) down.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stage {
    /// The feature fusion sub-network.
    Fusion,
    /// A level of an encoder.
    Encoder {
        /// Index in the table of variants; for KPCN 0 or 1, the diffuse or the specular network.
        encoder: usize,
        /// Level, 0 to 4.
        level: usize,
    },
    /// The latent's convolution.
    Latent,
    /// A level of the decoder.
    Decoder {
        /// Level, 0 to 4.
        level: usize,
    },
    /// The output convolution, or a level's convolution to kernels.
    Head {
        /// Level, 0 to 3.
        level: usize,
    },
}

/// Description of one tensor of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WeightSpec {
    /// Path of module fields, such as `decoder.levels.0.deconv.weight`.
    pub name: String,
    /// Axes, outermost first; see [`Role`].
    pub shape: Vec<usize>,
    /// The kind of its values.
    pub role: Role,
    /// The part of the network that it belongs to.
    pub stage: Stage,
}

#[allow(clippy::len_without_is_empty, reason = "no tensor is empty")]
impl WeightSpec {
    /// Number of values.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether the optimizer changes the tensor; see [`Role::is_trainable`].
    pub fn is_trainable(&self) -> bool {
        self.role.is_trainable()
    }

    /// Output channels of a kernel: the rows of its matrix. `None` for all other tensors.
    pub fn rows(&self) -> Option<usize> {
        match self.role {
            Role::Convolution => Some(self.shape[0]),
            Role::Deconvolution => Some(self.shape[1]),
            _ => None,
        }
    }

    /// Number of inputs that one output of the kernel sums up; 1 for all other tensors.
    ///
    /// A deconvolution has stride 2, so a quarter of its taps reach each output.
    pub fn fan_in(&self) -> usize {
        match (self.role, &self.shape[..]) {
            (Role::Convolution, [_, inputs, height, width]) => inputs * height * width,
            (Role::Deconvolution, [inputs, _, height, width]) => inputs * height * width / 4,
            _ => 1,
        }
    }

    /// Name of the layer: the path without the tensor's own name.
    pub fn layer(&self) -> &str {
        self.name.rsplit_once('.').map_or("", |(layer, _)| layer)
    }
}

/// The weights of a trained network by name, for [`crate::ModelConfig::load`].
#[derive(Debug, Default)]
pub struct Weights(BTreeMap<String, Weight>);

impl Weights {
    /// Indexes weights by their names.
    pub fn new(weights: Vec<Weight>) -> Self {
        Weights(
            weights
                .into_iter()
                .map(|weight| (weight.name.clone(), weight))
                .collect(),
        )
    }

    fn take(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, WeightsError> {
        let weight = self
            .0
            .remove(name)
            .ok_or_else(|| WeightsError::Missing { name: name.into() })?;
        if weight.shape != shape || weight.data.len() != shape.iter().product::<usize>() {
            return Err(WeightsError::Shape {
                name: name.into(),
                expected: shape.into(),
                found: weight.shape,
            });
        }
        Ok(weight.data)
    }

    pub(crate) fn all_taken(&self) -> Result<(), WeightsError> {
        match self.0.keys().next() {
            None => Ok(()),
            Some(first) => Err(WeightsError::Unknown {
                name: first.clone(),
                count: self.0.len(),
            }),
        }
    }
}

/// A difference between weights and the network that a [`crate::ModelConfig`] describes.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum WeightsError {
    /// A tensor of the network is missing.
    #[error("weight {name} is missing")]
    Missing { name: String },
    /// A tensor has another shape.
    #[error("weight {name}: expected shape {expected:?}, found {found:?}")]
    Shape {
        name: String,
        expected: Vec<usize>,
        found: Vec<usize>,
    },
    /// The network does not have these tensors.
    #[error("weight {name} is not part of this network ({count} such weights)")]
    Unknown {
        name: String,
        /// Number of unknown tensors.
        count: usize,
    },
}

/// Returns the values of a tensor for a [`Builder`], or `None` if the builder only describes the
/// network.
type ValueSource<'a> = dyn FnMut(&WeightSpec, Init) -> Result<Option<Vec<f32>>, WeightsError> + 'a;

/// Creates the tensors of the module under construction. Names are relative to the module.
pub struct Builder<'a> {
    source: &'a mut ValueSource<'a>,
    device: &'a Device,
    path: Vec<String>,
    stage: Stage,
    next_id: u64,
}

impl<'a> Builder<'a> {
    pub(crate) fn new(source: &'a mut ValueSource<'a>, device: &'a Device) -> Self {
        Builder {
            source,
            device,
            path: Vec::new(),
            stage: Stage::Fusion,
            next_id: 1,
        }
    }

    pub(crate) fn enter(&mut self, stage: Stage) -> &mut Self {
        self.stage = stage;
        self
    }

    pub(crate) fn part<T>(
        &mut self,
        name: impl ToString,
        build: impl FnOnce(&mut Self) -> Result<T, WeightsError>,
    ) -> Result<T, WeightsError> {
        self.path.push(name.to_string());
        let part = build(self);
        self.path.pop();
        part
    }

    /// Builds a list of parts under `name.0`, `name.1`, ...
    pub(crate) fn list<T>(
        &mut self,
        name: &str,
        count: usize,
        mut build: impl FnMut(&mut Self, usize) -> Result<T, WeightsError>,
    ) -> Result<Vec<T>, WeightsError> {
        self.part(name, |b| {
            (0..count).map(|i| b.part(i, |b| build(b, i))).collect()
        })
    }

    /// A trainable tensor.
    pub(crate) fn parameter<const D: usize>(
        &mut self,
        name: &str,
        role: Role,
        shape: [usize; D],
        init: Init,
    ) -> Result<Param<Tensor<D>>, WeightsError> {
        let (id, tensor) = self.tensor(name, role, shape, init)?;
        let param = Param::initialized(id, tensor);
        // The setting is needed on a device without gradients, too: a later `train()` uses it.
        Ok(param.set_require_grad(true))
    }

    pub(crate) fn running_state(
        &mut self,
        name: &str,
        role: Role,
        len: usize,
        init: Init,
    ) -> Result<RunningState<Tensor<1>>, WeightsError> {
        let (id, tensor) = self.tensor(name, role, [len], init)?;
        Ok(RunningState::with_id(id, tensor))
    }

    fn tensor<const D: usize>(
        &mut self,
        name: &str,
        role: Role,
        shape: [usize; D],
        init: Init,
    ) -> Result<(ParamId, Tensor<D>), WeightsError> {
        self.path.push(name.to_string());
        let spec = WeightSpec {
            name: self.path.join("."),
            shape: shape.to_vec(),
            role,
            stage: self.stage,
        };
        self.path.pop();
        let data = match (self.source)(&spec, init)? {
            Some(values) => TensorData::new(values, shape),
            None => TensorData::new(vec![0.0f32], [1; D]),
        };
        let id = ParamId::from(self.next_id);
        self.next_id += 1;
        Ok((id, Tensor::from_data(data, self.device)))
    }
}

/// Initial values, random ones from `rng`.
pub(crate) fn random(
    rng: &mut impl rand::Rng,
) -> impl FnMut(&WeightSpec, Init) -> Result<Option<Vec<f32>>, WeightsError> {
    |spec, init| Ok(Some(init.values(&spec.shape, rng)))
}

/// Values taken from `weights`.
pub(crate) fn taken(
    weights: &mut Weights,
) -> impl FnMut(&WeightSpec, Init) -> Result<Option<Vec<f32>>, WeightsError> {
    |spec, _| weights.take(&spec.name, &spec.shape).map(Some)
}

pub(crate) fn described(
    specs: &mut Vec<WeightSpec>,
) -> impl FnMut(&WeightSpec, Init) -> Result<Option<Vec<f32>>, WeightsError> {
    |spec, _| {
        specs.push(spec.clone());
        Ok(None)
    }
}

/// Collects every float tensor of a module with its path, in the order of the fields.
#[derive(Default)]
pub(crate) struct WeightCollector {
    path: Vec<String>,
    pub(crate) weights: Vec<Weight>,
}

impl ModuleVisitor for WeightCollector {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_string());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let data = param.val().into_data();
        self.weights.push(Weight {
            name: self.path.join("."),
            shape: data.shape().to_vec(),
            data: data.try_to_vec::<f32>().expect("the network is float32"),
        });
    }
}
