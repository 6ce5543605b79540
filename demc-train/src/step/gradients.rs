//! The gradient of a network as a whole: norm and clipping.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
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
