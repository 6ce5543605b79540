//! Feature maps and the operations on them: by our kernels or by Burn's tensor operations.

use burn::module::RunningState;
use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::tensor::{Tensor, module::max_pool2d, ops::MaxPoolOptions};

use super::activation::Activation;
use super::choice::Ops;
use super::{filter, kernels};

/// A batch of feature maps, `[B, C, H, W]` in the paper's terms.
///
/// For the kernels the tensor is `[B, H, W, C]` and contiguous. Its shape has the channels last,
/// not only its strides, so that Burn's own work on it (the sum of two gradients) runs on
/// contiguous memory. For Burn's operations the tensor is `[B, C, H, W]`.
#[derive(Clone, Debug)]
pub struct Maps {
    tensor: Tensor<4>,
    ops: Ops,
}

impl Maps {
    /// Maps that use `ops`, or Burn's operations if the tensor's device has no kernels.
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

    /// The maps as a tensor in Burn's layout.
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

    /// The operations that run on these maps.
    pub fn ops(&self) -> Ops {
        self.ops
    }

    /// A 3x3 convolution with padding 1 and a bias.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, H, W]`.
    pub fn conv3x3(self, conv: &Conv2d, activation: Activation) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => {
                let (weight, bias) = conv_parameters(conv);
                kernels::conv3x3(self.tensor, weight, bias, activation)
            }
            Ops::Burn => activation.apply(conv.forward(self.tensor)),
        };
        Maps { tensor, ..self }
    }

    /// A 5x5 convolution with padding 2 and a bias.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, H, W]`.
    pub fn conv5x5(self, conv: &Conv2d, activation: Activation) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => {
                let (weight, bias) = conv_parameters(conv);
                kernels::conv5x5(self.tensor, weight, bias, activation)
            }
            Ops::Burn => activation.apply(conv.forward(self.tensor)),
        };
        Maps { tensor, ..self }
    }

    /// A 4x4 deconvolution with stride 2, padding 1 and a bias: exactly twice the size.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, 2H, 2W]`.
    pub fn deconv4x4(self, deconv: &ConvTranspose2d, activation: Activation) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => {
                let bias = deconv.bias.as_ref().expect("a deconvolution has a bias");
                kernels::deconv4x4(self.tensor, deconv.weight.val(), bias.val(), activation)
            }
            Ops::Burn => activation.apply(deconv.forward(self.tensor)),
        };
        Maps { tensor, ..self }
    }

    /// The 1x1 convolution, with bias, of the concatenation of `parts` (Eq. 2). The kernels do not
    /// store the concatenation.
    ///
    /// # Shapes
    /// `[B, K_i, H, W]` to `[B, out, H, W]`; the convolution has the sum of the `K_i` as input.
    ///
    /// # Panics
    /// If the kernels run and there are not one to three parts.
    pub fn fuse(parts: Vec<Maps>, conv: &Conv2d, activation: Activation) -> Self {
        let (tensors, ops) = split(parts);
        let tensor = match ops {
            Ops::Kernels => {
                let (weight, bias) = conv_parameters(conv);
                kernels::fuse(tensors, weight, bias, activation)
            }
            Ops::Burn => activation.apply(conv.forward(Tensor::cat(tensors, 1))),
        };
        Maps { tensor, ops }
    }

    /// A 1x1 convolution with bias.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, H, W]`.
    pub fn conv1x1(self, conv: &Conv2d) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => {
                let (weight, bias) = conv_parameters(conv);
                kernels::fuse(vec![self.tensor], weight, bias, Activation::None)
            }
            Ops::Burn => conv.forward(self.tensor),
        };
        Maps { tensor, ..self }
    }

    /// Gamma-compressed colour in linear light, `max(x, 0)^gamma`. Without a gradient.
    pub fn radiance(self, gamma: f32) -> Self {
        let tensor = self.tensor.detach().clamp_min(0.0).powf_scalar(gamma);
        Maps { tensor, ..self }
    }

    /// Linear light in gamma space, `x^(1/gamma)` where it is above `darkest`, else 0.
    pub fn gamma(self, gamma: f32, darkest: f32) -> Self {
        let visible = self.tensor.clone().detach().greater_elem(darkest).float();
        let powers = self.tensor.clamp_min(darkest).powf_scalar(1.0 / gamma);
        let tensor = powers * visible;
        Maps { tensor, ..self }
    }

    /// The mean of each 2x2 window. Without a gradient.
    ///
    /// # Shapes
    /// `[B, C, H, W]` to `[B, C, H / 2, W / 2]`.
    pub fn halve(self) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => kernels::halve(self.tensor),
            Ops::Burn => filter::halve(self.tensor),
        };
        Maps { tensor, ..self }
    }

    /// An image, filtered with a 5x5 or 21x21 kernel per pixel, the softmax of its logits; the border
    /// is replicated. One more logit becomes a fourth channel, its sigmoid. The image has no gradient.
    /// Logits of a single image filter all images, without autodiff.
    ///
    /// # Shapes
    /// `[B, 3, H, W]` and logits `[B, L, H, W]`, L = 25 or 441, to `[B, 3, H, W]`; with one more
    /// logit, to `[B, 4, H, W]`.
    pub fn filter(self, logits: Maps) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => kernels::filter(self.tensor, logits.tensor),
            Ops::Burn => filter::filter(self.tensor, logits.tensor),
        };
        Maps { tensor, ..self }
    }

    /// `y + b U(coarse - D(y))`: y are the first three channels, b is the fourth; D is the 2x2 mean,
    /// U the bilinear doubling with half-pixel centres.
    ///
    /// # Shapes
    /// `[B, 4, H, W]` and `[B, 3, H / 2, W / 2]` to `[B, 3, H, W]`.
    pub fn blend(self, coarse: Maps) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => kernels::blend(self.tensor, coarse.tensor),
            Ops::Burn => filter::blend(self.tensor, coarse.tensor),
        };
        Maps { tensor, ..self }
    }

    /// Batch normalisation. A device with autodiff uses the statistics of the batch and updates the
    /// running ones; a device without autodiff uses the running ones.
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
            // A frozen normalisation under autodiff: no kernel has that gradient.
            Ops::Kernels => {
                let y = activation.apply(norm.forward(self.into_nchw()));
                return Maps::from_nchw(y, ops);
            }
            Ops::Burn => activation.apply(norm.forward(self.tensor)),
        };
        Maps { tensor, ops }
    }

    /// 2x2 max-pooling with stride 2. Of several equal maxima, the first receives the gradient.
    ///
    /// # Shapes
    /// `[B, C, H, W]` to `[B, C, H / 2, W / 2]`.
    pub fn max_pool(self) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => kernels::max_pool(self.tensor),
            Ops::Burn => max_pool2d(self.tensor, MaxPoolOptions::new([2, 2])),
        };
        Maps { tensor, ..self }
    }

    /// These maps doubled by repeating pixels, then the channels of `skip`.
    ///
    /// # Shapes
    /// `[B, C, H, W]` and `[B, K, 2H, 2W]` to `[B, C + K, 2H, 2W]`.
    pub fn double_and_append(self, skip: Maps) -> Self {
        let tensor = match self.ops {
            Ops::Kernels => kernels::double_and_append(self.tensor, skip.tensor),
            Ops::Burn => {
                let [batch, channels, height, width] = self.tensor.dims();
                let repeated: Tensor<6> = self
                    .tensor
                    .reshape([batch, channels, height, 1, width, 1])
                    .expand([batch, channels, height, 2, width, 2]);
                let doubled = repeated.reshape([batch, channels, 2 * height, 2 * width]);
                Tensor::cat(vec![doubled, skip.tensor], 1)
            }
        };
        Maps { tensor, ..self }
    }

    /// The first image, and the others.
    ///
    /// # Shapes
    /// `[B, C, H, W]` to `[1, C, H, W]` and `[B - 1, C, H, W]`.
    pub fn split_first(self) -> (Self, Self) {
        let [batch, ..] = self.dims();
        let first = self.tensor.clone().narrow(0, 0, 1);
        let others = self.tensor.narrow(0, 1, batch - 1);
        let ops = self.ops;
        let [first, others] = [first, others].map(|tensor| Maps { tensor, ops });
        (first, others)
    }

    /// The images of all parts as one batch.
    ///
    /// # Shapes
    /// `[B_i, C, H, W]` to `[sum of B_i, C, H, W]`.
    pub fn cat_images(parts: Vec<Maps>) -> Self {
        let (tensors, ops) = split(parts);
        let tensor = Tensor::cat(tensors, 0);
        Maps { tensor, ops }
    }

    /// The concatenation of all parts over channels.
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

fn split(parts: Vec<Maps>) -> (Vec<Tensor<4>>, Ops) {
    let ops = parts.first().expect("at least one part").ops;
    assert!(
        parts.iter().all(|part| part.ops == ops),
        "all parts use the same operations"
    );
    (parts.into_iter().map(|part| part.tensor).collect(), ops)
}

fn conv_parameters(conv: &Conv2d) -> (Tensor<4>, Tensor<1>) {
    let bias = conv.bias.as_ref().expect("a convolution has a bias");
    (conv.weight.val(), bias.val())
}

/// Updates a running statistic by that of a batch, as `burn::nn::BatchNorm` does.
fn update(running: &RunningState<Tensor<1>>, batch: Tensor<1>, momentum: f64) {
    let old = running.value_sync().mul_scalar(1.0 - momentum);
    let new = old.add(batch.detach().mul_scalar(momentum));
    running.update(new.detach());
}
