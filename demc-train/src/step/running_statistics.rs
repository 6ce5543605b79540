//! Snapshot of batch normalisation's running statistics, restored after a skipped step: the forward
//! pass updates them before the loss is known to be non-finite.

use std::collections::VecDeque;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;
use demc_model::{Denoiser, WeightSpec};

/// The running statistics of a network at one moment.
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

    /// `model` with these statistics.
    pub fn restore(self, model: Denoiser, specs: &[WeightSpec]) -> Denoiser {
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
