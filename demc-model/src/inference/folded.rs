//! Convolutions for inference: slices of a module's weights, or copies with a folded normalisation.

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::tensor::Tensor;
use demc_kernels::Convolution;

/// Weight and bias of a convolution or deconvolution.
///
/// A batch normalisation with running statistics is `scale * x + shift` for each channel. It is
/// folded into the weight and bias of the convolution before it and costs no time.
pub struct FoldedConv {
    weight: HostValues,
    bias: HostValues,
}

enum HostValues {
    /// The values of a parameter.
    Shared(FlexTensor),
    /// A copy with a folded normalisation.
    Folded(Vec<f32>),
}

impl HostValues {
    fn new<const D: usize>(tensor: Tensor<D>) -> Self {
        let tensor = tensor
            .try_into_primitive::<Flex>()
            .expect("weights on the device of the images");
        HostValues::Shared(tensor.to_contiguous())
    }

    fn as_slice(&self) -> &[f32] {
        match self {
            HostValues::Shared(tensor) => tensor.storage::<f32>(),
            HostValues::Folded(values) => values,
        }
    }
}

impl FoldedConv {
    /// The convolution with a ReLU after it.
    pub fn rectified(&self) -> Convolution<'_> {
        Convolution::rectified(self.weight(), self.bias())
    }

    /// A convolution and the normalisation of its output, on `flex`.
    ///
    /// # Shapes
    /// Weight `[out, in, h, w]`.
    ///
    /// # Panics
    /// If the weights are on another device.
    pub fn conv(conv: &Conv2d, norm: Option<&BatchNorm>) -> Self {
        let bias = conv.bias.as_ref().expect("a convolution has a bias");
        let plain = FoldedConv {
            weight: HostValues::new(conv.weight.val()),
            bias: HostValues::new(bias.val()),
        };
        plain.folded(norm, |weight, scale| {
            let filter = weight.len() / scale.len();
            for (filter, scale) in weight.chunks_exact_mut(filter).zip(scale) {
                filter.iter_mut().for_each(|x| *x *= scale);
            }
        })
    }

    /// The output convolution as one of 3x3: a kernel of 1x1 gets zeros around it.
    ///
    /// # Shapes
    /// Weight `[out, in, 1, 1]` or `[out, in, 3, 3]`.
    pub fn head(conv: &Conv2d) -> Self {
        let folded = Self::conv(conv, None);
        if conv.kernel_size != [1, 1] {
            return folded;
        }
        let mut weight = vec![0.0; 9 * folded.weight().len()];
        for (taps, value) in weight.chunks_exact_mut(9).zip(folded.weight()) {
            taps[4] = *value;
        }
        FoldedConv {
            weight: HostValues::Folded(weight),
            ..folded
        }
    }

    /// A deconvolution and the normalisation of its output, on `flex`.
    ///
    /// # Shapes
    /// Weight `[in, out, 4, 4]`.
    ///
    /// # Panics
    /// If the weights are on another device.
    pub fn deconv(deconv: &ConvTranspose2d, norm: Option<&BatchNorm>) -> Self {
        let bias = deconv.bias.as_ref().expect("a deconvolution has a bias");
        let plain = FoldedConv {
            weight: HostValues::new(deconv.weight.val()),
            bias: HostValues::new(bias.val()),
        };
        plain.folded(norm, |weight, scale| {
            for input in weight.chunks_exact_mut(16 * scale.len()) {
                for (taps, scale) in input.chunks_exact_mut(16).zip(scale) {
                    taps.iter_mut().for_each(|x| *x *= scale);
                }
            }
        })
    }

    /// The convolution with the normalisation folded in. `scale_weight` multiplies the weights of
    /// each output channel by the channel's scale.
    fn folded(self, norm: Option<&BatchNorm>, scale_weight: impl Fn(&mut [f32], &[f32])) -> Self {
        let Some(norm) = norm else { return self };
        let beta = HostValues::new(norm.beta.val());
        let mean = HostValues::new(norm.running_mean.value());
        let scale = norm_scale(norm);
        let mut weight = self.weight().to_vec();
        scale_weight(&mut weight, &scale);
        let bias = (self.bias().iter())
            .zip(mean.as_slice())
            .zip(&scale)
            .zip(beta.as_slice())
            .map(|(((bias, mean), scale), beta)| (bias - mean) * scale + beta)
            .collect();
        FoldedConv {
            weight: HostValues::Folded(weight),
            bias: HostValues::Folded(bias),
        }
    }

    /// The weight in the layout of weight files.
    pub fn weight(&self) -> &[f32] {
        self.weight.as_slice()
    }

    /// The bias, one value per output channel.
    pub fn bias(&self) -> &[f32] {
        self.bias.as_slice()
    }

    /// Number of output channels.
    pub fn outputs(&self) -> usize {
        self.bias().len()
    }
}

/// The scale of each channel of a batch normalisation with its running statistics:
/// `gamma / sqrt(variance + epsilon)`.
///
/// # Panics
/// If the normalisation is not on `flex`.
pub fn norm_scale(norm: &BatchNorm) -> Vec<f32> {
    let gamma = HostValues::new(norm.gamma.val());
    let variance = HostValues::new(norm.running_var.value());
    let statistics = gamma.as_slice().iter().zip(variance.as_slice());
    statistics
        .map(|(gamma, variance)| {
            let deviation = (f64::from(*variance) + norm.epsilon).sqrt();
            (f64::from(*gamma) / deviation) as f32
        })
        .collect()
}
