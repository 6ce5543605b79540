//! Adam (Kingma and Ba 2014), or Muon (Jordan et al. 2024) for the kernels, and what happens to a gradient before it: its norm, and
//! clipping to one.
//!
//! The arithmetic of a step is Burn's ([`demc_model::ops::adam`], [`demc_model::ops::muon`]); its state is kept here, by the names of the weights, because Burn's
//! whole-module optimizer restores state on a default device that may not exist on the machine at hand.

use std::collections::BTreeMap;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use demc_model::dormant::{Dormant, Renewal};
use demc_model::ops::adam::{Moments, Rule, sum_of_squares};
use demc_model::ops::muon;
use demc_model::weights::outputs;
use demc_model::{Denoiser, Ops, Weight};

use crate::config::TrainConfig;
use crate::rate::Rate;

/// Decay of the first moment (the defaults of Kingma and Ba, which the paper does not change).
const BETA_1: f32 = 0.9;
/// Decay of the second moment.
const BETA_2: f32 = 0.999;
/// Steps without a gradient after which a channel is dormant.
pub const DORMANT_STEPS: u64 = 175;
/// A channel is dormant where its bias's first moment has fallen below this share of the second one's root: without a gradient
/// that takes 175 steps, and with one, however small, it never happens. Ours.
const GONE: f32 = 1e-8;
/// The layer whose channels are the image.
const HEAD: &str = "decoder.head";
/// Suffix of the first moment's name in a checkpoint.
const FIRST: &str = ".m";
/// Suffix of the second moment's name.
const SECOND: &str = ".v";
/// Suffix of the name of Muon's sum of gradients.
const VELOCITY: &str = ".velocity";

/// Adam over a network's trainable weights; over kernels of up to `train.muon` outputs, Muon.
pub struct Optimizer {
    rule: Rule,
    muon: usize,
    steps: u64,
    memories: BTreeMap<String, Memory>,
}

/// What is kept of a weight's gradients, flattened.
#[allow(
    clippy::large_enum_variant,
    reason = "handles of tensors, a hundred of them"
)]
enum Memory {
    Adam(Moments),
    Muon(Tensor<1>),
}

impl Memory {
    /// The tensors, with the suffixes of their names in a checkpoint.
    fn tensors(&self) -> Vec<(&'static str, &Tensor<1>)> {
        match self {
            Memory::Adam(Moments { first, second }) => vec![(FIRST, first), (SECOND, second)],
            Memory::Muon(velocity) => vec![(VELOCITY, velocity)],
        }
    }

    fn map(self, f: impl Fn(Tensor<1>) -> Tensor<1>) -> Self {
        match self {
            Memory::Adam(Moments { first, second }) => Memory::Adam(Moments {
                first: f(first),
                second: f(second),
            }),
            Memory::Muon(velocity) => Memory::Muon(f(velocity)),
        }
    }
}

impl Optimizer {
    /// A fresh optimizer.
    pub fn new(config: &TrainConfig) -> Self {
        let rule = Rule {
            beta_1: BETA_1,
            beta_2: BETA_2,
            epsilon: config.adam_epsilon,
        };
        Optimizer {
            rule,
            muon: config.muon,
            steps: 0,
            memories: BTreeMap::new(),
        }
    }

    /// Steps taken so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// The network after one step along `grads`.
    pub fn step(&mut self, rate: Rate, model: Denoiser, grads: GradientsParams) -> Denoiser {
        let mut mapper = Step {
            ops: model.ops(),
            optimizer: self,
            rate,
            grads,
            path: Vec::new(),
        };
        let model = model.map(&mut mapper);
        self.steps += 1;
        model
    }

    /// Layers and their channels; those that have had no gradient for 175 steps, or none ever, are dormant.
    pub fn dormant(&self) -> Dormant {
        let biases = self.memories.iter().filter_map(|(name, memory)| {
            let layer = name.strip_suffix(".bias").filter(|layer| *layer != HEAD)?;
            let Memory::Adam(moments) = memory else {
                return None;
            };
            let channels = values(&moments.first)
                .into_iter()
                .zip(values(&moments.second));
            let dormant = channels.map(|(first, second)| first.abs() <= GONE * second.sqrt());
            Some((layer.to_string(), dormant.collect()))
        });
        biases.collect()
    }

    /// Forgets what it knows of the weights that begin anew.
    pub fn forget(&mut self, renewal: &Renewal) {
        let memories = std::mem::take(&mut self.memories).into_iter();
        self.memories = memories
            .map(|(name, memory)| {
                let places: Vec<usize> = renewal.places(&name).collect();
                if places.is_empty() {
                    return (name, memory);
                }
                let memory = memory.map(|tensor| {
                    let mut values = values(&tensor);
                    places.iter().for_each(|place| values[*place] = 0.0);
                    Tensor::from_data(values.as_slice(), &tensor.device())
                });
                (name, memory)
            })
            .collect();
    }

    /// The state on the host: two tensors a weight that Adam moves, one a kernel that Muon moves, by name.
    pub fn state(&self) -> Vec<Weight> {
        let tensors = self.memories.iter().flat_map(|(name, memory)| {
            let tensors = memory.tensors().into_iter();
            tensors.map(move |(suffix, tensor)| {
                let data = values(tensor);
                Weight {
                    name: format!("{name}{suffix}"),
                    shape: vec![data.len()],
                    data,
                }
            })
        });
        tensors.collect()
    }

    /// The optimizer that [`Self::state`] describes after `steps` steps; the name of a moment whose partner is missing
    /// as the error.
    pub fn restore(
        config: &TrainConfig,
        steps: u64,
        state: Vec<Weight>,
        device: &Device,
    ) -> Result<Self, String> {
        let mut tensors: BTreeMap<String, Tensor<1>> = state
            .into_iter()
            .map(|weight| {
                let data = TensorData::new(weight.data, weight.shape);
                (weight.name, Tensor::from_data(data, device))
            })
            .collect();
        let mut memories = BTreeMap::new();
        while let Some((name, tensor)) = tensors.pop_first() {
            let (weight, memory) = if let Some(weight) = name.strip_suffix(VELOCITY) {
                (weight, Memory::Muon(tensor))
            } else {
                let weight = name.strip_suffix(FIRST).ok_or_else(|| name.clone())?;
                let second = tensors
                    .remove(&format!("{weight}{SECOND}"))
                    .ok_or_else(|| name.clone())?;
                let first = tensor;
                (weight, Memory::Adam(Moments { first, second }))
            };
            memories.insert(weight.to_string(), memory);
        }
        Ok(Optimizer {
            steps,
            memories,
            ..Optimizer::new(config)
        })
    }

    /// Whether it knows of each of these trainable weights what a step needs, and of no others.
    pub fn fits(&self, weights: &[Weight]) -> bool {
        let known = |weight: &&Weight| {
            let size = weight.data.len();
            let muons = self.is_muons(&weight.name, &weight.shape);
            self.memories.get(&weight.name).is_some_and(|memory| {
                matches!(memory, Memory::Muon(_)) == muons
                    && memory.tensors().iter().all(|(_, t)| t.dims() == [size])
            })
        };
        let trainable: Vec<&Weight> = weights.iter().filter(|w| w.is_trainable()).collect();
        trainable.len() == self.memories.len() && trainable.iter().all(known)
    }

    /// Whether Muon moves the weight with this name and shape. The head's outputs are the image, no features: Adam's, as with Jordan et al.
    fn is_muons(&self, name: &str, shape: &[usize]) -> bool {
        let outputs = outputs(name, shape);
        outputs.is_some_and(|outputs| outputs <= self.muon) && !name.starts_with(HEAD)
    }
}

/// A tensor on the host.
fn values(tensor: &Tensor<1>) -> Vec<f32> {
    let data = tensor.to_data();
    data.try_to_vec().expect("moments are float32")
}

/// One step over all weights of a network.
struct Step<'a> {
    ops: Ops,
    optimizer: &'a mut Optimizer,
    rate: Rate,
    grads: GradientsParams,
    path: Vec<String>,
}

impl ModuleMapper for Step<'_> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_string());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, tensor, mapper) = param.consume();
        let Some(grad) = self.grads.remove::<D>(id) else {
            return Param::from_mapped_value(id, tensor, mapper);
        };
        let name = self.path.join(".");
        let shape = tensor.dims();
        let optimizer = &mut *self.optimizer;
        let memory = optimizer.memories.remove(&name);
        let (stepped, memory) = if optimizer.is_muons(&name, &shape) {
            let velocity = match memory {
                Some(Memory::Muon(velocity)) => Some(velocity),
                _ => None,
            };
            let (stepped, velocity) =
                muon::step(&name, self.rate.lr, tensor.inner(), grad, velocity);
            (stepped, Memory::Muon(velocity))
        } else {
            let moments = match memory {
                Some(Memory::Adam(moments)) => Some(moments),
                _ => None,
            };
            let (stepped, moments) = optimizer.rule.step(
                self.ops,
                self.rate.of(&name, &shape),
                optimizer.steps,
                tensor.inner(),
                grad,
                moments,
            );
            (stepped, Memory::Adam(moments))
        };
        optimizer.memories.insert(name, memory);
        let tensor = Tensor::from_inner(stepped).require_grad();
        Param::from_mapped_value(id, tensor, mapper)
    }
}

/// The Euclidean norm of the whole gradient.
pub fn grad_norm(model: &Denoiser, grads: &GradientsParams) -> f64 {
    struct Flattened<'a> {
        grads: &'a GradientsParams,
        tensors: Vec<Tensor<1>>,
    }
    impl ModuleVisitor for Flattened<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.grads.get::<D>(param.id) {
                self.tensors.push(grad.reshape([-1]));
            }
        }
    }
    let mut flattened = Flattened {
        grads,
        tensors: Vec::new(),
    };
    model.visit(&mut flattened);
    sum_of_squares(model.ops(), flattened.tensors).sqrt()
}

/// The gradient times `factor`.
pub fn scaled(model: &Denoiser, grads: GradientsParams, factor: f64) -> GradientsParams {
    struct Scale {
        grads: GradientsParams,
        factor: f64,
    }
    impl ModuleVisitor for Scale {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.grads.remove::<D>(param.id) {
                self.grads.register(param.id, grad.mul_scalar(self.factor));
            }
        }
    }
    let mut scale = Scale { grads, factor };
    model.visit(&mut scale);
    scale.grads
}

#[cfg(test)]
mod tests;
