//! Adam (Kingma and Ba 2014), or Muon (Jordan et al. 2024) for kernels.
//!
//! [`demc_model::ops::update`] and [`demc_model::ops::muon`] compute a step. The state is kept here,
//! by the names of the weights: Burn's whole-module optimizer restores state on a default device,
//! which may not exist on this machine.

use std::collections::{BTreeMap, BTreeSet};

use burn::module::{Module, ModuleMapper, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use demc_model::ops::muon;
use demc_model::ops::update::{AdamConstants, AdamMoments};
use demc_model::{Denoiser, ModelConfig, Ops, Role, Stage, Weight, WeightSpec};

use crate::config::Config;

/// Decay of the first moment (Kingma and Ba's default; the paper names no other).
const BETA_1: f32 = 0.9;
/// Decay of the second moment (Kingma and Ba's default).
const BETA_2: f32 = 0.999;
/// Keeps the division finite (Kingma and Ba 2014).
const EPSILON: f32 = 1e-8;
/// Steps without a gradient after which a channel is dormant.
pub const DORMANT_STEPS: u64 = 175;
/// A channel is dormant if its bias's first moment is at most this share of the root of the second.
/// Ours: without a gradient that takes 175 steps; with a gradient, however small, it never happens.
const DORMANT_SHARE: f32 = 1e-8;
/// Suffix of the first moment's name in a checkpoint.
const FIRST: &str = ".m";
/// Suffix of the second moment's name.
const SECOND: &str = ".v";
/// Suffix of the name of Muon's sum of gradients.
const VELOCITY: &str = ".velocity";

/// Adam for a network's trainable weights, or Muon for its kernels up to `optimizer.muon_max_rows`
/// rows.
pub struct Optimizer {
    constants: AdamConstants,
    /// Rows up to which Muon updates a kernel; `None` with Adam alone.
    muon_rows: Option<usize>,
    weight_decay: f64,
    /// Factor of the rate for the weights of `trunk`.
    trunk_rate: f64,
    /// The names of a U-Net's own weights, if the network has others.
    trunk: BTreeSet<String>,
    steps: u64,
    /// Every weight of the network, in module order.
    specs: Vec<WeightSpec>,
    states: BTreeMap<String, WeightState>,
}

/// The state of one weight, flattened.
#[allow(
    clippy::large_enum_variant,
    reason = "handles of tensors, a hundred of them"
)]
enum WeightState {
    Adam(AdamMoments),
    Muon(Tensor<1>),
}

impl WeightState {
    fn tensors(&self) -> Vec<(&'static str, &Tensor<1>)> {
        match self {
            WeightState::Adam(AdamMoments { first, second }) => {
                vec![(FIRST, first), (SECOND, second)]
            }
            WeightState::Muon(velocity) => vec![(VELOCITY, velocity)],
        }
    }
}

/// The number of dormant channels of a network: channels without a gradient for 175 steps, or ever.
///
/// A channel that is zero behind its ReLU at every pixel has no gradient, so no step revives it
/// (Sokar et al. 2023, "The Dormant Neuron Phenomenon").
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DormantChannels {
    /// Dormant channels.
    pub dormant: usize,
    /// All channels except those of the head, which are the image.
    pub channels: usize,
}

impl DormantChannels {
    /// Share of dormant channels, 0 to 1.
    pub fn share(self) -> f64 {
        self.dormant as f64 / self.channels.max(1) as f64
    }
}

impl Optimizer {
    /// An optimizer before its first step.
    pub fn new(config: &Config) -> Self {
        let constants = AdamConstants {
            beta_1: BETA_1,
            beta_2: BETA_2,
            epsilon: EPSILON,
        };
        let trunk = config.model.trunk().filter(|trunk| *trunk != config.model);
        let trunk = trunk.iter().flat_map(ModelConfig::weight_specs);
        Optimizer {
            constants,
            muon_rows: config.optimizer.muon_rows(),
            weight_decay: config.optimizer.weight_decay,
            trunk_rate: config.optimizer.trunk_rate,
            trunk: trunk.map(|spec| spec.name).collect(),
            steps: 0,
            specs: config.model.weight_specs(),
            states: BTreeMap::new(),
        }
    }

    /// Steps taken so far, without skipped ones.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Every weight of the network, in module order.
    pub fn specs(&self) -> &[WeightSpec] {
        &self.specs
    }

    /// Takes one step along `grads`; returns the updated network.
    pub fn step(&mut self, lr: f64, model: Denoiser, grads: GradientsParams) -> Denoiser {
        let specs = std::mem::take(&mut self.specs);
        let mut step = OptimizerStep {
            ops: model.ops(),
            optimizer: self,
            lr,
            grads,
            specs: specs.iter(),
        };
        let model = model.map(&mut step);
        self.specs = specs;
        self.steps += 1;
        model
    }

    /// Counts the dormant channels, from Adam's moments of the shifts before the ReLUs: the biases,
    /// or the shift of a normalisation that follows.
    pub fn dormant(&self) -> DormantChannels {
        let mut count = DormantChannels::default();
        for (spec, next) in self.specs.iter().zip(self.specs.iter().skip(1)) {
            let is_shift = match spec.role {
                // A normalisation cancels the bias before it.
                Role::Bias => !next.role.is_norm() && !matches!(spec.stage, Stage::Head { .. }),
                role => role == Role::NormShift,
            };
            let Some(WeightState::Adam(moments)) = self.states.get(&spec.name) else {
                continue;
            };
            if !is_shift {
                continue;
            }
            for (first, second) in values(&moments.first)
                .into_iter()
                .zip(values(&moments.second))
            {
                count.channels += 1;
                count.dormant += usize::from(first.abs() <= DORMANT_SHARE * second.sqrt());
            }
        }
        count
    }

    /// The state on the host, by name: two tensors per weight of Adam, one per kernel of Muon.
    pub fn state(&self) -> Vec<Weight> {
        let tensors = self.states.iter().flat_map(|(name, state)| {
            let tensors = state.tensors().into_iter();
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

    /// The optimizer with the state that [`Self::state`] returned after `steps` steps.
    ///
    /// # Errors
    /// The name of a moment without its partner.
    pub fn restore(
        config: &Config,
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
        let mut states = BTreeMap::new();
        while let Some((name, tensor)) = tensors.pop_first() {
            let (weight, state) = if let Some(weight) = name.strip_suffix(VELOCITY) {
                (weight, WeightState::Muon(tensor))
            } else {
                let weight = name.strip_suffix(FIRST).ok_or_else(|| name.clone())?;
                let second = tensors
                    .remove(&format!("{weight}{SECOND}"))
                    .ok_or_else(|| name.clone())?;
                let first = tensor;
                (weight, WeightState::Adam(AdamMoments { first, second }))
            };
            states.insert(weight.to_string(), state);
        }
        Ok(Optimizer {
            steps,
            states,
            ..Optimizer::new(config)
        })
    }

    /// Whether the state belongs to this network and optimizer: one per trainable weight, of its
    /// size.
    pub fn is_complete(&self) -> bool {
        let has_state = |spec: &&WeightSpec| {
            self.states.get(&spec.name).is_some_and(|state| {
                matches!(state, WeightState::Muon(_)) == self.is_for_muon(spec)
                    && state
                        .tensors()
                        .iter()
                        .all(|(_, t)| t.dims() == [spec.len()])
            })
        };
        let trainable: Vec<&WeightSpec> = self
            .specs
            .iter()
            .filter(|s| s.role.is_trainable())
            .collect();
        trainable.len() == self.states.len() && trainable.iter().all(has_state)
    }

    /// Whether Muon updates this weight. The head computes the image, not features: Adam updates
    /// it, as in Jordan et al.
    fn is_for_muon(&self, spec: &WeightSpec) -> bool {
        let fits = |max| spec.rows().is_some_and(|rows| rows <= max);
        !matches!(spec.stage, Stage::Head { .. }) && self.muon_rows.is_some_and(fits)
    }
}

fn values(tensor: &Tensor<1>) -> Vec<f32> {
    let data = tensor.to_data();
    data.try_to_vec().expect("moments are float32")
}

/// One step over all weights of a network.
struct OptimizerStep<'a> {
    ops: Ops,
    optimizer: &'a mut Optimizer,
    lr: f64,
    grads: GradientsParams,
    specs: std::slice::Iter<'a, WeightSpec>,
}

impl ModuleMapper for OptimizerStep<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let spec = self.specs.next().expect("a description of every weight");
        let (id, tensor, mapper) = param.consume();
        let Some(grad) = self.grads.remove::<D>(id) else {
            return Param::from_mapped_value(id, tensor, mapper);
        };
        assert_eq!(spec.shape, tensor.dims(), "{}", spec.name);
        let optimizer = &mut *self.optimizer;
        let state = optimizer.states.remove(&spec.name);
        let mut weight = tensor.inner();
        let factor = if optimizer.trunk.contains(&spec.name) {
            optimizer.trunk_rate
        } else {
            1.0
        };
        let lr = factor * self.lr;
        if optimizer.weight_decay > 0.0 && spec.rows().is_some() {
            weight = weight.mul_scalar(1.0 - lr * optimizer.weight_decay);
        }
        let (stepped, state) = if optimizer.is_for_muon(spec) {
            let velocity = match state {
                Some(WeightState::Muon(velocity)) => Some(velocity),
                _ => None,
            };
            let (stepped, velocity) = muon::step(spec, lr, weight, grad, velocity);
            (stepped, WeightState::Muon(velocity))
        } else {
            let moments = match state {
                Some(WeightState::Adam(moments)) => Some(moments),
                _ => None,
            };
            let (stepped, moments) =
                optimizer
                    .constants
                    .step(self.ops, lr, optimizer.steps, weight, grad, moments);
            (stepped, WeightState::Adam(moments))
        };
        optimizer.states.insert(spec.name.clone(), state);
        let tensor = Tensor::from_inner(stepped).require_grad();
        Param::from_mapped_value(id, tensor, mapper)
    }
}

#[cfg(test)]
mod tests;
