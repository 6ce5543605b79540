//! Weights where nothing is differentiated: slices of the module's own tensors, or folded copies.

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::tensor::Tensor;

/// Weight and bias of a layer.
///
/// A batch normalisation with its running statistics is `scale * x + shift` for each channel, and so is what a
/// convolution does after its products: the two become one convolution, and the normalisation costs nothing.
pub struct Layer {
    weight: Values,
    bias: Values,
}

/// Values on the host.
enum Values {
    /// Those of a parameter.
    Shared(FlexTensor),
    /// Made here.
    Folded(Vec<f32>),
}

impl Values {
    fn of<const D: usize>(tensor: Tensor<D>) -> Self {
        let tensor = tensor
            .try_into_primitive::<Flex>()
            .expect("weights that are where the images are");
        Values::Shared(tensor.to_contiguous())
    }

    fn as_slice(&self) -> &[f32] {
        match self {
            Values::Shared(tensor) => tensor.storage::<f32>(),
            Values::Folded(values) => values,
        }
    }
}

impl Layer {
    /// A convolution and what normalises its output, on `flex`.
    ///
    /// # Shapes
    /// Weight `[out, in, h, w]`.
    ///
    /// # Panics
    /// On another device.
    pub fn conv(conv: &Conv2d, norm: Option<&BatchNorm>) -> Self {
        let bias = conv.bias.as_ref().expect("a convolution has a bias");
        let plain = Layer {
            weight: Values::of(conv.weight.val()),
            bias: Values::of(bias.val()),
        };
        plain.folded(norm, |weight, scale| {
            let filter = weight.len() / scale.len();
            for (filter, scale) in weight.chunks_exact_mut(filter).zip(scale) {
                filter.iter_mut().for_each(|x| *x *= scale);
            }
        })
    }

    /// A deconvolution and what normalises its output, on `flex`.
    ///
    /// # Shapes
    /// Weight `[in, out, 4, 4]`.
    ///
    /// # Panics
    /// On another device.
    pub fn deconv(deconv: &ConvTranspose2d, norm: Option<&BatchNorm>) -> Self {
        let bias = deconv.bias.as_ref().expect("a deconvolution has a bias");
        let plain = Layer {
            weight: Values::of(deconv.weight.val()),
            bias: Values::of(bias.val()),
        };
        plain.folded(norm, |weight, scale| {
            for input in weight.chunks_exact_mut(16 * scale.len()) {
                for (taps, scale) in input.chunks_exact_mut(16).zip(scale) {
                    taps.iter_mut().for_each(|x| *x *= scale);
                }
            }
        })
    }

    /// `scale_weight` multiplies what gives an output channel with that channel's scale.
    fn folded(self, norm: Option<&BatchNorm>, scale_weight: impl Fn(&mut [f32], &[f32])) -> Self {
        let Some(norm) = norm else { return self };
        let beta = Values::of(norm.beta.val());
        let mean = Values::of(norm.running_mean.value());
        let scale = scale_of(norm);
        let mut weight = self.weight().to_vec();
        scale_weight(&mut weight, &scale);
        let bias = (self.bias().iter())
            .zip(mean.as_slice())
            .zip(&scale)
            .zip(beta.as_slice())
            .map(|(((bias, mean), scale), beta)| (bias - mean) * scale + beta)
            .collect();
        Layer {
            weight: Values::Folded(weight),
            bias: Values::Folded(bias),
        }
    }

    /// In the layout of weight files.
    pub fn weight(&self) -> &[f32] {
        self.weight.as_slice()
    }

    /// One an output channel.
    pub fn bias(&self) -> &[f32] {
        self.bias.as_slice()
    }

    /// Output channels.
    pub fn outputs(&self) -> usize {
        self.bias().len()
    }
}

/// What a batch normalisation with its running statistics multiplies each channel by: `gamma / sqrt(variance + epsilon)`.
///
/// # Panics
/// On another device than `flex`.
pub fn scale_of(norm: &BatchNorm) -> Vec<f32> {
    let gamma = Values::of(norm.gamma.val());
    let variance = Values::of(norm.running_var.value());
    let statistics = gamma.as_slice().iter().zip(variance.as_slice());
    statistics
        .map(|(gamma, variance)| {
            let deviation = (f64::from(*variance) + norm.epsilon).sqrt();
            (f64::from(*gamma) / deviation) as f32
        })
        .collect()
}
