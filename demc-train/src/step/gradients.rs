//! The gradient of a network as a whole: norm, clipping, sums, and exchange between ranks.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Tensor, TensorData};
use demc_model::Denoiser;
use demc_model::ops::update::sum_of_squares;

/// The Euclidean norm of the whole gradient.
pub fn grad_norm(model: &Denoiser, grads: &GradientsParams) -> f64 {
    struct FlatGradients<'a> {
        grads: &'a GradientsParams,
        tensors: Vec<Tensor<1>>,
    }
    impl ModuleVisitor for FlatGradients<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.grads.get::<D>(param.id) {
                self.tensors.push(grad.reshape([-1]));
            }
        }
    }
    let mut flat = FlatGradients {
        grads,
        tensors: Vec::new(),
    };
    model.visit(&mut flat);
    sum_of_squares(model.ops(), flat.tensors).sqrt()
}

/// The gradient times `factor`.
pub fn scaled(model: &Denoiser, grads: GradientsParams, factor: f64) -> GradientsParams {
    struct GradientScaler {
        grads: GradientsParams,
        factor: f64,
    }
    impl ModuleVisitor for GradientScaler {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.grads.remove::<D>(param.id) {
                self.grads.register(param.id, grad.mul_scalar(self.factor));
            }
        }
    }
    let mut scaler = GradientScaler { grads, factor };
    model.visit(&mut scaler);
    scaler.grads
}

/// The sum of two gradients of one network.
pub fn added(model: &Denoiser, left: GradientsParams, right: GradientsParams) -> GradientsParams {
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
pub fn flattened(model: &Denoiser, grads: &GradientsParams) -> Vec<f32> {
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
pub fn with_values(model: &Denoiser, grads: GradientsParams, values: &[f32]) -> GradientsParams {
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
