//! The sum of the gradients of a step's micro-batches, on this rank and over all ranks.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Tensor, TensorData};
use demc_model::Denoiser;

use super::Reduce;
use super::tree::{Block, PairwiseSum};

/// The gradients of this rank's micro-batches, summed in their order.
#[derive(Default)]
pub struct GradientSum(PairwiseSum<GradientsParams>);

impl GradientSum {
    /// Adds the gradient of micro-batch `number` of the step, after those before it.
    pub fn add(&mut self, model: &Denoiser, number: usize, gradient: GradientsParams) {
        let block = Block {
            first: number,
            terms: 1,
            sum: gradient,
        };
        self.0.push(block, |left, right| added(model, left, right));
    }
}

impl Reduce {
    /// The sum of the gradients of all `batches` micro-batches of a step; `None` without one.
    pub fn sum(
        &self,
        model: &Denoiser,
        GradientSum(own): GradientSum,
        batches: usize,
    ) -> Option<GradientsParams> {
        if self.count() == 1 {
            return own.total(|left, right| added(model, left, right));
        }
        let mut shape = None;
        let mut blocks = Vec::new();
        for Block { first, terms, sum } in own.into_blocks() {
            let values = flattened(model, &sum);
            shape.get_or_insert(sum);
            blocks.push(Block {
                first,
                terms,
                sum: values,
            });
        }
        let values = self.sum_blocks(blocks, batches)?;
        Some(with_values(model, shape?, &values))
    }
}

/// The sum of two gradients of one network.
fn added(model: &Denoiser, left: GradientsParams, right: GradientsParams) -> GradientsParams {
    struct GradientAdder {
        left: GradientsParams,
        right: GradientsParams,
    }
    impl ModuleVisitor for GradientAdder {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let left = self.left.remove::<D>(param.id);
            let right = self.right.remove::<D>(param.id);
            let sum = match (left, right) {
                (Some(left), Some(right)) => left + right,
                (Some(only), None) | (None, Some(only)) => only,
                (None, None) => return,
            };
            self.left.register(param.id, sum);
        }
    }
    let mut adder = GradientAdder { left, right };
    model.visit(&mut adder);
    adder.left
}

/// The values of all gradients on the host, in module order.
fn flattened(model: &Denoiser, grads: &GradientsParams) -> Vec<f32> {
    struct Flattener<'a> {
        grads: &'a GradientsParams,
        values: Vec<f32>,
    }
    impl ModuleVisitor for Flattener<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.grads.get::<D>(param.id) {
                let values = grad.into_data().try_to_vec::<f32>();
                self.values.extend(values.expect("gradients are float32"));
            }
        }
    }
    let mut flattener = Flattener {
        grads,
        values: Vec::new(),
    };
    model.visit(&mut flattener);
    flattener.values
}

/// `grads` with other values, in the order of [`flattened`].
///
/// # Panics
/// If there are too few values.
fn with_values(model: &Denoiser, grads: GradientsParams, values: &[f32]) -> GradientsParams {
    struct Replacer<'a> {
        grads: GradientsParams,
        values: &'a [f32],
    }
    impl ModuleVisitor for Replacer<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.grads.remove::<D>(param.id) {
                let (own, rest) = self.values.split_at(grad.dims().iter().product());
                self.values = rest;
                let data = TensorData::new(own.to_vec(), grad.dims());
                let grad = Tensor::<D>::from_data(data, &grad.device());
                self.grads.register(param.id, grad);
            }
        }
    }
    let mut replacer = Replacer { grads, values };
    model.visit(&mut replacer);
    replacer.grads
}
