//! Feature maps on their way through the network.

use burn::module::RunningState;
use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::tensor::Tensor;

use super::{Ops, kernels, stock};

/// What follows an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    None,
    /// `max(x, 0)`, fused into the operation by the kernels.
    Relu,
}

impl Activation {
    pub(super) fn is_relu(self) -> bool {
        self == Activation::Relu
    }
}

/// A batch of feature maps, `[B, C, H, W]` in the paper's terms.
///
/// The kernels keep channels last, `[B, H, W, C]` and contiguous: in the shape of the tensor and not in its strides, so that
/// what Burn itself does with it (the sum of two gradients) runs on contiguous memory. Burn's operations keep `[B, C, H, W]`.
#[derive(Clone, Debug)]
pub struct Maps {
    tensor: Tensor<4>,
    /// Those that run on the tensor's device.
    ops: Ops,
}

impl Maps {
    /// Maps to work on with `ops`, or with Burn's operations where the tensor's device has no kernels.
    ///
    /// # Shapes
    /// `[B, C, H, W]`.
    pub fn from_nchw(tensor: Tensor<4>, ops: Ops) -> Self {
        let ops = ops.on(&tensor.device());
        let tensor = match ops {
            Ops::Kernels => kernels::nhwc_from_nchw(tensor),
            Ops::Burn => tensor,
        };
        Maps { tensor, ops }
    }

    /// The maps as Burn has them.
    ///
    /// # Shapes
    /// `[B, C, H, W]`.
    pub fn into_nchw(self) -> Tensor<4> {
        match self.ops {
            Ops::Kernels => kernels::nchw_from_nhwc(self.tensor),
            Ops::Burn => self.tensor,
        }
    }

    /// Batch, channels, height, width.
    pub fn dims(&self) -> [usize; 4] {
        let dims = self.tensor.dims();
        match self.ops {
            Ops::Kernels => [dims[0], dims[3], dims[1], dims[2]],
            Ops::Burn => dims,
        }
    }

    /// The operations that run here.
    pub fn ops(&self) -> Ops {
        self.ops
    }

    /// A 3x3 convolution with padding 1 and its bias.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, H, W]`.
    pub fn conv3x3(self, conv: &Conv2d, activation: Activation) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => {
                let (weight, bias) = conv_parameters(conv);
                kernels::conv3x3(self.tensor, weight, bias, activation)
            }
            Ops::Burn => stock::conv(self.tensor, conv, activation),
        };
        Maps { tensor, ..self }
    }

    /// A 4x4 deconvolution with stride 2 and padding 1 and its bias: exactly twice the size.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, 2H, 2W]`.
    pub fn deconv4x4(self, deconv: &ConvTranspose2d, activation: Activation) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => {
                let bias = deconv.bias.as_ref().expect("a deconvolution has a bias");
                kernels::deconv4x4(self.tensor, deconv.weight.val(), bias.val(), activation)
            }
            Ops::Burn => stock::deconv(self.tensor, deconv, activation),
        };
        Maps { tensor, ..self }
    }

    /// The 1x1 convolution, with bias, of the concatenation of `parts` (Eq. 2), which the kernels never make.
    ///
    /// # Shapes
    /// `[B, K_i, H, W]` to `[B, out, H, W]`; the convolution has the sum of the `K_i` as input.
    ///
    /// # Panics
    /// Where the kernels run and there are not two or three parts.
    pub fn fuse(parts: Vec<Maps>, conv: &Conv2d, activation: Activation) -> Self {
        let (tensors, ops) = split(parts);
        let tensor = match ops {
            Ops::Kernels => {
                let (weight, bias) = conv_parameters(conv);
                kernels::fuse(tensors, weight, bias, activation)
            }
            Ops::Burn => stock::conv(Tensor::cat(tensors, 1), conv, activation),
        };
        Maps { tensor, ops }
    }

    /// Batch normalisation: with the batch's statistics on a device with autodiff, whose running ones it updates;
    /// with the running ones elsewhere.
    ///
    /// # Shapes
    /// `[B, C, H, W]` to the same.
    pub fn batch_norm(self, norm: &BatchNorm, activation: Activation) -> Self {
        let ops = self.ops;
        let tensor = match ops {
            Ops::Kernels if !self.tensor.device().is_autodiff() => {
                kernels::batch_norm(self.tensor, norm, activation)
            }
            Ops::Kernels if norm.training.is_enabled() => {
                let (y, [mean, variance]) =
                    kernels::batch_norm_train(self.tensor, norm, activation);
                update(&norm.running_mean, mean, norm.momentum);
                update(&norm.running_var, variance, norm.momentum);
                y
            }
            // Frozen in a network that trains: no kernel has that gradient.
            Ops::Kernels => {
                let y = stock::batch_norm(self.into_nchw(), norm, activation);
                return Maps::from_nchw(y, ops);
            }
            Ops::Burn => stock::batch_norm(self.tensor, norm, activation),
        };
        Maps { tensor, ops }
    }

    /// 2x2 max-pooling with stride 2. A gradient goes to the first of several largest values.
    ///
    /// # Shapes
    /// `[B, C, H, W]` to `[B, C, H / 2, W / 2]`.
    pub fn max_pool(self) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => kernels::max_pool(self.tensor),
            Ops::Burn => stock::max_pool(self.tensor),
        };
        Maps { tensor, ..self }
    }

    /// The channels of all parts, one after another.
    ///
    /// # Shapes
    /// `[B, K_i, H, W]` to `[B, sum of K_i, H, W]`.
    pub fn cat(mut parts: Vec<Maps>) -> Self {
        if parts.len() == 1 {
            return parts.remove(0);
        }
        let (tensors, ops) = split(parts);
        let channels = match ops {
            Ops::Kernels => 3,
            Ops::Burn => 1,
        };
        let tensor = Tensor::cat(tensors, channels);
        Maps { tensor, ops }
    }
}

/// The tensors of `parts` and the operations that run on them all.
fn split(parts: Vec<Maps>) -> (Vec<Tensor<4>>, Ops) {
    let ops = parts.first().expect("at least one part").ops;
    assert!(parts.iter().all(|part| part.ops == ops), "maps of one kind");
    (parts.into_iter().map(|part| part.tensor).collect(), ops)
}

fn conv_parameters(conv: &Conv2d) -> (Tensor<4>, Tensor<1>) {
    let bias = conv.bias.as_ref().expect("a convolution has a bias");
    (conv.weight.val(), bias.val())
}

/// Takes a batch's statistic into the running one, as `burn::nn::BatchNorm` does.
fn update(running: &RunningState<Tensor<1>>, batch: Tensor<1>, momentum: f64) {
    let old = running.value_sync().mul_scalar(1.0 - momentum);
    let new = old.add(batch.detach().mul_scalar(momentum));
    running.update(new.detach());
}
