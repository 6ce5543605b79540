//! The four kinds of layer of the network: Burn's modules with the paper's settings.
//!
//! Burn's defaults differ from the paper's network: a random bias under Xavier, batch normalisation
//! with epsilon 1e-5 and momentum 0.1. So every setting is explicit here.

use burn::module::{Module, Param};
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use burn::nn::{BatchNorm, PaddingConfig2d};

use crate::init::{GREY_HEAD_SCALE, Init};
use crate::ops::{Activation, Maps};
use crate::weights::{Builder, Role, WeightsError};

/// Epsilon of every batch normalisation (the authors' TensorFlow 1.13 default; docs/network.md).
pub const NORM_EPSILON: f64 = 1e-3;

/// Share of a batch's statistics in the running ones (TensorFlow's momentum of 0.99).
pub const NORM_MOMENTUM: f64 = 0.01;

/// The block of Sec. 3.2: a 3x3 convolution with padding 1, optional batch normalisation, and a
/// ReLU.
#[derive(Module, Debug)]
pub struct ConvBlock {
    /// The convolution, with bias.
    pub conv: Conv2d,
    /// The normalisation between convolution and ReLU, if there is one.
    pub norm: Option<BatchNorm>,
}

impl ConvBlock {
    /// A block with `channels` in and out, whose convolution starts with this bias.
    pub(crate) fn build(
        b: &mut Builder,
        channels: [usize; 2],
        normalised: bool,
        bias: Init,
    ) -> Result<Self, WeightsError> {
        Ok(ConvBlock {
            conv: b.part("conv", |b| conv3x3(b, channels, Init::Xavier(1.0), bias))?,
            norm: normalised
                .then(|| b.part("norm", |b| norm(b, channels[1])))
                .transpose()?,
        })
    }

    /// Convolution, normalisation, ReLU.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, out, H, W]`.
    pub fn forward(&self, x: Maps) -> Maps {
        match &self.norm {
            Some(norm) => x
                .conv3x3(&self.conv, Activation::None)
                .batch_norm(norm, Activation::Relu),
            None => x.conv3x3(&self.conv, Activation::Relu),
        }
    }
}

/// Convolutions with ReLU, one after the other.
#[derive(Module, Debug)]
pub struct ConvStack {
    /// The convolutions, with bias.
    pub convs: Vec<Conv2d>,
}

impl ConvStack {
    pub(crate) fn build(
        b: &mut Builder,
        inputs: usize,
        outputs: &[usize],
    ) -> Result<Self, WeightsError> {
        let mut channels = inputs;
        let convs = b.list("convs", outputs.len(), |b, index| {
            let built = conv3x3(
                b,
                [channels, outputs[index]],
                Init::Xavier(1.0),
                Init::Zeros,
            );
            channels = outputs[index];
            built
        })?;
        Ok(ConvStack { convs })
    }

    /// All convolutions.
    pub fn forward(&self, x: Maps) -> Maps {
        self.convs
            .iter()
            .fold(x, |x, conv| x.conv3x3(conv, Activation::Relu))
    }
}

pub(crate) fn conv3x3(
    b: &mut Builder,
    channels: [usize; 2],
    weight: Init,
    bias: Init,
) -> Result<Conv2d, WeightsError> {
    conv(b, channels, 3, weight, bias)
}

/// A 1x1 convolution, initialised as nearly zero.
pub(crate) fn conv1x1(b: &mut Builder, channels: [usize; 2]) -> Result<Conv2d, WeightsError> {
    conv(b, channels, 1, Init::Xavier(GREY_HEAD_SCALE), Init::Zeros)
}

/// The 1x1 convolution of a skip fusion (Eq. 2), initialised as the sum of its inputs (Eq. 3).
pub(crate) fn skip_fusion(b: &mut Builder, channels: [usize; 2]) -> Result<Conv2d, WeightsError> {
    conv(b, channels, 1, Init::IdentitySum, Init::Zeros)
}

/// A convolution that keeps the size, with bias.
pub(crate) fn conv(
    b: &mut Builder,
    [input, output]: [usize; 2],
    kernel: usize,
    weight: Init,
    bias: Init,
) -> Result<Conv2d, WeightsError> {
    Ok(Conv2d {
        weight: b.parameter(
            "weight",
            Role::Convolution,
            [output, input, kernel, kernel],
            weight,
        )?,
        bias: Some(b.parameter("bias", Role::Bias, [output], bias)?),
        stride: [1, 1],
        kernel_size: [kernel, kernel],
        dilation: [1, 1],
        groups: 1,
        padding: PaddingConfig2d::Explicit(kernel / 2, kernel / 2, kernel / 2, kernel / 2),
    })
}

/// The 4x4 deconvolution with stride 2 and padding 1: exactly twice the size (Sec. 3.2),
/// initialised as bilinear up-sampling (Sec. 4.2).
pub(crate) fn deconv4x4(
    b: &mut Builder,
    [input, output]: [usize; 2],
) -> Result<ConvTranspose2d, WeightsError> {
    Ok(ConvTranspose2d {
        weight: b.parameter(
            "weight",
            Role::Deconvolution,
            [input, output, 4, 4],
            Init::Bilinear,
        )?,
        bias: Some(b.parameter("bias", Role::Bias, [output], Init::Zeros)?),
        stride: [2, 2],
        kernel_size: [4, 4],
        dilation: [1, 1],
        groups: 1,
        padding: [1, 1],
        padding_out: [0, 0],
        channels: [input, output],
    })
}

pub(crate) fn norm(b: &mut Builder, channels: usize) -> Result<BatchNorm, WeightsError> {
    Ok(BatchNorm {
        gamma: b.parameter("gamma", Role::NormScale, [channels], Init::Ones)?,
        beta: b.parameter("beta", Role::NormShift, [channels], Init::Zeros)?,
        training: Param::from_bool(true),
        running_mean: b.running_state("running_mean", Role::RunningMean, channels, Init::Zeros)?,
        running_var: b.running_state("running_var", Role::RunningVariance, channels, Init::Ones)?,
        momentum: NORM_MOMENTUM,
        epsilon: NORM_EPSILON,
    })
}
