//! The running statistics of batch normalisation, kept for a step that must not have happened: the forward pass has changed
//! them before anybody knows that its loss is not finite.

use std::collections::VecDeque;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;
use demc_model::Denoiser;

/// The field of a module whose children are running statistics end in.
const RUNNING: &str = "running_";

/// The running statistics of a network at a time.
pub struct RunningStatistics(VecDeque<Tensor<1>>);

impl RunningStatistics {
    /// Those of `model`, updates that are still under way included.
    pub fn of(model: &Denoiser) -> Self {
        // Burn merges an update at the next one; `valid` does so now.
        let _ = model.valid();
        let mut keep = Keep::default();
        model.visit(&mut keep);
        RunningStatistics(keep.found)
    }

    /// `model` with these statistics.
    pub fn restore(self, model: Denoiser) -> Denoiser {
        let _ = model.valid();
        model.map(&mut Restore {
            kept: self.0,
            path: Vec::new(),
        })
    }
}

/// Whether the innermost field of `path` holds a running statistic.
fn is_running(path: &[String]) -> bool {
    path.last().is_some_and(|name| name.starts_with(RUNNING))
}

#[derive(Default)]
struct Keep {
    path: Vec<String>,
    found: VecDeque<Tensor<1>>,
}

impl ModuleVisitor for Keep {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_string());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if is_running(&self.path) {
            self.found.push_back(param.val().reshape([-1]));
        }
    }
}

struct Restore {
    kept: VecDeque<Tensor<1>>,
    path: Vec<String>,
}

impl ModuleMapper for Restore {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_string());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if !is_running(&self.path) {
            return param;
        }
        let (id, now, mapper) = param.consume();
        let kept = self.kept.pop_front().expect("the same network");
        Param::from_mapped_value(id, kept.reshape(now.dims()), mapper)
    }
}
