//! A training step and an inference of this project, for the comparison with its peers.
//!
//! Only this module defines them; a faster way to train or infer is adopted here.

use std::convert::Infallible;

use burn::tensor::{Device, Tensor, TensorData};
use demc_infer::Bundle;
use demc_model::Denoiser;
use demc_train::Config;
use demc_train::step::optimizer::Optimizer;
use demc_train::step::trainer::{StepReport, Trainer};

use crate::case::CaseInput;

/// A network that repeats a training step on one batch.
pub struct Training {
    trainer: Trainer,
    input: CaseInput,
    lr: f64,
}

impl Training {
    /// The paper's loss and optimizer (Sec. 4.2) on one batch. `device` has no autodiff.
    pub fn new(bundle: Bundle, input: CaseInput, lr: f64, device: &Device) -> Self {
        let config = Config {
            model: bundle.meta.model,
            ..Config::default()
        };
        let device = device.clone().autodiff();
        let model = moved(&bundle.model, &device);
        let optimizer = Optimizer::new(&config);
        Training {
            trainer: Trainer::new(&config, model, optimizer, None, device),
            input,
            lr,
        }
    }

    /// Batch to the device, forward, loss, backward, norm of the gradient, Adam.
    pub fn run(&mut self) -> StepReport {
        let batch = || Ok::<_, Infallible>(self.input.batch.clone());
        let report = self.trainer.step(self.lr, batch);
        report.expect("no batch fails")
    }
}

/// A network that denoises one image repeatedly.
pub struct Inference {
    model: Denoiser,
    color_gamma: Tensor<4>,
    features_z: Tensor<4>,
}

impl Inference {
    /// Copies the input to `device` first, because peers also start with tensors.
    pub fn new(bundle: Bundle, input: CaseInput, device: &Device) -> Self {
        let tensor = |values: Vec<f32>, channels| {
            let shape = [input.batch.size, channels, input.height, input.width];
            Tensor::from_data(TensorData::new(values, shape), device)
        };
        Inference {
            model: moved(&bundle.model, device),
            color_gamma: tensor(input.batch.color, 3),
            features_z: tensor(input.batch.features, demc_data::FEATURES),
        }
    }

    /// The output on the host, `[B, 3, H, W]`.
    ///
    /// # Panics
    /// If the device fails.
    pub fn run(&self) -> Vec<f32> {
        self.model
            .forward(self.color_gamma.clone(), self.features_z.clone())
            .try_into_vec_as::<f32>()
            .expect("the device computes")
    }
}

/// A copy of the network on `device`.
fn moved(model: &Denoiser, device: &Device) -> Denoiser {
    let mut weights = demc_model::Weights::new(model.weights());
    model
        .config()
        .load(&mut weights, device)
        .expect("the network's own weights")
}
