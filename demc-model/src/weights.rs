//! Named weights in and out of a network: how modules are built, saved and loaded.
//!
//! A module asks a [`Builder`] for each of its tensors by name and shape, in a fixed order. Where they come from is
//! the builder's affair: drawn ([`crate::init`]) for a new network, taken from [`Weights`] for a trained one. So both
//! ways share one description of the network, a load is strict by construction, and parameter ids are the same in
//! every process, which is what lets Adam's state find its parameters after a resume.

use std::collections::BTreeMap;

use burn::module::{Module, ModuleVisitor, Param, ParamId, RunningState};
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

/// The inputs that one output sums up in the layer with the weight `name` of this shape: 1 for what is no kernel.
///
/// # Shapes
/// Convolutions `[out, in, h, w]`; deconvolutions `[in, out, h, w]`, whose stride of 2 lets a quarter of the taps reach each output.
pub fn fan_in(name: &str, shape: &[usize]) -> usize {
    match *shape {
        [inputs, _, height, width] if is_deconvolution(name) => inputs * height * width / 4,
        [_, inputs, height, width] => inputs * height * width,
        _ => 1,
    }
}

/// Outputs of a kernel; `None` for what is no kernel.
///
/// # Shapes
/// As of [`fan_in`].
pub fn outputs(name: &str, shape: &[usize]) -> Option<usize> {
    match *shape {
        [_, outputs, _, _] if is_deconvolution(name) => Some(outputs),
        [outputs, _, _, _] => Some(outputs),
        _ => None,
    }
}

/// Whether a layer or weight is a deconvolution's, by its name: its first two axes are the other way round.
pub(crate) fn is_deconvolution(name: &str) -> bool {
    name.contains("deconv")
}

/// The weights of a trained network by name, to be taken one by one.
#[derive(Debug, Default)]
pub struct Weights(BTreeMap<String, Weight>);

impl Weights {
    /// Collects weights by their names.
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

    /// Fails if anything has not been taken.
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

/// Why weights do not make the network that a [`crate::ModelConfig`] describes.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum WeightsError {
    /// A tensor of the network is not there.
    #[error("weight {name} is missing")]
    Missing {
        /// Name of the tensor.
        name: String,
    },
    /// A tensor has another shape.
    #[error("weight {name}: expected shape {expected:?}, found {found:?}")]
    Shape {
        /// Name of the tensor.
        name: String,
        /// Shape in the network.
        expected: Vec<usize>,
        /// Shape in the file.
        found: Vec<usize>,
    },
    /// There are tensors that the network does not have.
    #[error("weight {name} does not belong to this network ({count} such)")]
    Unknown {
        /// First of them by name.
        name: String,
        /// How many there are.
        count: usize,
    },
}

/// Where a [`Builder`] gets its values.
type Source<'a> = dyn FnMut(&str, &[usize], Init) -> Result<Vec<f32>, WeightsError> + 'a;

/// Hands a module its tensors, by name within the module under construction.
pub struct Builder<'a> {
    source: &'a mut Source<'a>,
    device: &'a Device,
    path: Vec<String>,
    next_id: u64,
}

impl<'a> Builder<'a> {
    pub(crate) fn new(source: &'a mut Source<'a>, device: &'a Device) -> Self {
        Builder {
            source,
            device,
            path: Vec::new(),
            next_id: 1,
        }
    }

    /// Builds a part under `name`.
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
        shape: [usize; D],
        init: Init,
    ) -> Result<Param<Tensor<D>>, WeightsError> {
        let (id, tensor) = self.tensor(name, shape, init)?;
        let param = Param::initialized(id, tensor);
        // Also on a device without gradients: the setting is kept for a later `train()`.
        Ok(param.set_require_grad(true))
    }

    /// A tensor that the forward pass updates: the statistics of a batch normalisation.
    pub(crate) fn running_state(
        &mut self,
        name: &str,
        len: usize,
        init: Init,
    ) -> Result<RunningState<Tensor<1>>, WeightsError> {
        let (id, tensor) = self.tensor(name, [len], init)?;
        Ok(RunningState::with_id(id, tensor))
    }

    fn tensor<const D: usize>(
        &mut self,
        name: &str,
        shape: [usize; D],
        init: Init,
    ) -> Result<(ParamId, Tensor<D>), WeightsError> {
        self.path.push(name.to_string());
        let values = (self.source)(&self.path.join("."), &shape, init);
        self.path.pop();
        let tensor = Tensor::from_data(TensorData::new(values?, shape), self.device);
        let id = ParamId::from(self.next_id);
        self.next_id += 1;
        Ok((id, tensor))
    }
}

/// A source that draws from `rng`.
pub(crate) fn drawn(
    rng: &mut impl rand::Rng,
) -> impl FnMut(&str, &[usize], Init) -> Result<Vec<f32>, WeightsError> {
    |_, shape, init| Ok(init.draw(shape, rng))
}

/// A source that takes from `weights`.
pub(crate) fn taken(
    weights: &mut Weights,
) -> impl FnMut(&str, &[usize], Init) -> Result<Vec<f32>, WeightsError> {
    |name, shape, _| weights.take(name, shape)
}

/// Every float tensor of a module with its path, in the order of the fields.
pub(crate) fn collect(module: &impl Module) -> Vec<Weight> {
    #[derive(Default)]
    struct Collector {
        path: Vec<String>,
        weights: Vec<Weight>,
    }

    impl ModuleVisitor for Collector {
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

    let mut collector = Collector::default();
    module.visit(&mut collector);
    collector.weights
}
