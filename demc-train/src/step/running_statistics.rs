//! Batch normalisation's running statistics: a snapshot, and their update in the order of the
//! micro-batches.
//!
//! A forward pass updates them before the loss is known to be non-finite, and each process sees its own
//! micro-batches only. So a step starts each forward pass from zeros, collects the shares of all
//! micro-batches, and adds them at its end.

use std::collections::VecDeque;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;
use demc_model::layers::NORM_MOMENTUM;
use demc_model::{Denoiser, WeightSpec};

/// The running statistics of a network at one moment; empty without batch normalisation.
#[derive(Clone)]
pub struct RunningStatistics(VecDeque<Tensor<1>>);

impl RunningStatistics {
    /// The statistics of `model`, whose weights `specs` describe.
    pub fn of(model: &Denoiser, specs: &[WeightSpec]) -> Self {
        // Burn applies an update at the next access; `valid` does so now.
        let _ = model.valid();
        let mut collector = StatisticsCollector {
            specs: specs.iter(),
            found: VecDeque::new(),
        };
        model.visit(&mut collector);
        RunningStatistics(collector.found)
    }

    /// Zeros instead of these statistics. A forward pass turns them into its batch's share: the
    /// batch's statistics times the momentum.
    pub fn zeros(&self) -> Self {
        let zeros = self.0.iter().map(Tensor::zeros_like);
        RunningStatistics(zeros.collect())
    }

    /// The values in module order.
    pub fn values(&self) -> Vec<f32> {
        self.0
            .iter()
            .flat_map(|statistic| {
                let values = statistic.to_data().try_to_vec::<f32>();
                values.expect("statistics are float32")
            })
            .collect()
    }

    /// These statistics after batches with these shares, in order:
    /// `running (1 - momentum) + share` for each, as in the forward pass.
    ///
    /// # Panics
    /// If a share has too few values.
    pub fn updated<'a>(&self, shares: impl Iterator<Item = &'a [f32]>) -> Self {
        let kept = (1.0 - NORM_MOMENTUM) as f32;
        let mut values = self.values();
        for share in shares {
            assert_eq!(share.len(), values.len(), "the same network");
            for (value, share) in values.iter_mut().zip(share) {
                *value = *value * kept + share;
            }
        }
        let mut rest = values.as_slice();
        let statistics = self.0.iter().map(|statistic| {
            let (own, after) = rest.split_at(statistic.dims()[0]);
            rest = after;
            Tensor::from_floats(own, &statistic.device())
        });
        RunningStatistics(statistics.collect())
    }

    /// `model` with these statistics.
    pub fn restore(self, model: Denoiser, specs: &[WeightSpec]) -> Denoiser {
        if self.0.is_empty() {
            return model;
        }
        let _ = model.valid();
        model.map(&mut StatisticsRestorer {
            specs: specs.iter(),
            saved: self.0,
        })
    }
}

/// Whether the next weight in module order is a running statistic.
fn is_running<'a>(specs: &mut impl Iterator<Item = &'a WeightSpec>) -> bool {
    let spec = specs.next().expect("a description of every weight");
    !spec.role.is_trainable()
}

struct StatisticsCollector<'a> {
    specs: std::slice::Iter<'a, WeightSpec>,
    found: VecDeque<Tensor<1>>,
}

impl ModuleVisitor for StatisticsCollector<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if is_running(&mut self.specs) {
            self.found.push_back(param.val().reshape([-1]));
        }
    }
}

struct StatisticsRestorer<'a> {
    specs: std::slice::Iter<'a, WeightSpec>,
    saved: VecDeque<Tensor<1>>,
}

impl ModuleMapper for StatisticsRestorer<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if !is_running(&mut self.specs) {
            return param;
        }
        let (id, current, mapper) = param.consume();
        let saved = self.saved.pop_front().expect("the same network");
        Param::from_mapped_value(id, saved.reshape(current.dims()), mapper)
    }
}
