//! Tensors and layers with random values.

use burn::module::{Param, RunningState};
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::nn::{BatchNorm, PaddingConfig2d};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A generator of tensors and layers. Values are in -1 to 1, and the seed is fixed.
pub struct RandomTensors(ChaCha8Rng);

impl RandomTensors {
    pub fn new() -> Self {
        RandomTensors(ChaCha8Rng::seed_from_u64(7))
    }

    pub fn tensor<const D: usize>(&mut self, shape: [usize; D], device: &Device) -> Tensor<D> {
        let len = shape.iter().product();
        let values: Vec<f32> = (0..len)
            .map(|_| self.0.random_range(-1.0..1.0f32))
            .collect();
        Tensor::from_data(TensorData::new(values, shape), device)
    }

    pub fn param<const D: usize>(&mut self, shape: [usize; D]) -> Param<Tensor<D>> {
        Param::from_tensor(self.tensor(shape, &device()))
    }

    pub fn conv(&mut self, [input, output]: [usize; 2], kernel: usize) -> Conv2d {
        let pad = kernel / 2;
        Conv2d {
            weight: self.param([output, input, kernel, kernel]),
            bias: Some(self.param([output])),
            stride: [1, 1],
            kernel_size: [kernel, kernel],
            dilation: [1, 1],
            groups: 1,
            padding: PaddingConfig2d::Explicit(pad, pad, pad, pad),
        }
    }

    pub fn deconv(&mut self, [input, output]: [usize; 2]) -> ConvTranspose2d {
        ConvTranspose2d {
            weight: self.param([input, output, 4, 4]),
            bias: Some(self.param([output])),
            stride: [2, 2],
            kernel_size: [4, 4],
            dilation: [1, 1],
            groups: 1,
            padding: [1, 1],
            padding_out: [0, 0],
            channels: [input, output],
        }
    }

    pub fn norm(&mut self, channels: usize) -> BatchNorm {
        BatchNorm {
            gamma: self.param([channels]),
            beta: self.param([channels]),
            training: Param::from_bool(true),
            running_mean: RunningState::new(self.tensor([channels], &device())),
            running_var: RunningState::new(self.tensor([channels], &device()).square()),
            momentum: 0.01,
            epsilon: 1e-3,
        }
    }
}

pub fn device() -> Device {
    Device::flex().autodiff()
}

pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().expect("float32")
}
