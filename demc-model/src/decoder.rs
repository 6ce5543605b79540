//! The decoder (Sec. 3.2): five deconvolutions, each followed by the fusion of the skips (Eq. 2),
//! and the head.

use burn::module::Module;
use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};

use crate::config::{COLOR_CHANNELS, Head, LEVELS, ModelConfig};
use crate::init::{GREY_HEAD_SCALE, Init};
use crate::kernel_head;
use crate::layers::{conv, deconv4x4, norm, skip_fusion};
use crate::ops::{Activation, Maps};
use crate::weights::{Builder, Stage, WeightsError};

/// Five levels from the deepest to the full resolution, and the head.
#[derive(Module, Debug)]
pub struct Decoder {
    /// The levels; index 0 is the deepest, at H/16 x W/16.
    pub levels: Vec<DecoderLevel>,
    /// The 1x1 (Fig. 3) or 3x3 (released reading) convolution to colour, followed by a ReLU; `None` with a
    /// kernel head.
    pub head: Option<Conv2d>,
    /// The convolutions to kernels of the last levels, deepest first; none without a kernel head.
    pub kernels: Vec<Conv2d>,
}

impl Decoder {
    /// A decoder; a grey head starts at `head_bias`, a flat image in gamma space.
    pub(crate) fn build(
        b: &mut Builder,
        config: &ModelConfig,
        head_bias: [f32; 3],
    ) -> Result<Self, WeightsError> {
        let channels = config.level_channels();
        let parts = 1 + config.variant.spec().encoders.len();
        let levels = b.list("levels", LEVELS, |b, k| {
            let level = LEVELS - 1 - k;
            b.enter(Stage::Decoder { level });
            let channels = [config.channels_below(level), channels[level]];
            DecoderLevel::build(b, config, channels, parts)
        })?;
        let init = match config.head {
            Head::Grey => Some((Init::Xavier(GREY_HEAD_SCALE), Init::Color(head_bias))),
            Head::Xavier => Some((Init::Xavier(1.0), Init::Zeros)),
            Head::Kernel => None,
        };
        let head = init
            .map(|(weight, bias)| {
                b.enter(Stage::Head { level: 0 }).part("head", |b| {
                    let side = config.reading.spec().head_kernel;
                    conv(b, [channels[0], COLOR_CHANNELS], side, weight, bias)
                })
            })
            .transpose()?;
        let kernels = match config.head {
            Head::Kernel => kernel_head::build(b, &channels)?,
            Head::Grey | Head::Xavier => Vec::new(),
        };
        Ok(Decoder {
            levels,
            head,
            kernels,
        })
    }

    /// Decodes a latent to an image. A kernel head filters `layers` with the same kernels.
    ///
    /// `skips` has one list per level from the deepest up, with one entry per encoder.
    ///
    /// # Shapes
    /// Latent `[B, K_5, H / 32, W / 32]`, skips of level k `[B, K, H / 2^(4 - k), W / 2^(4 - k)]`,
    /// the noisy colour in gamma space `[B, 3, H, W]`, to `[B, 3, H, W]` in gamma space, not
    /// negative. Layers in linear light `[L, 3, H, W]`, for B = 1, to the same.
    pub fn forward(
        &self,
        latent: Maps,
        skips: Vec<Vec<Maps>>,
        color_gamma: Maps,
        layers: Option<Maps>,
    ) -> (Maps, Option<Maps>) {
        let mut x = latent;
        let mut decoded = Vec::new();
        for (level, skips) in self.levels.iter().zip(skips) {
            x = level.forward(x, skips);
            if self.head.is_none() {
                decoded.push(x.clone());
            }
        }
        match &self.head {
            Some(head) if head.kernel_size == [1, 1] => {
                (Maps::fuse(vec![x], head, Activation::Relu), None)
            }
            Some(head) => (x.conv3x3(head, Activation::Relu), None),
            None => kernel_head::forward(&self.kernels, decoded, color_gamma, layers),
        }
    }
}

/// One up-sampling unit with its skip fusion.
#[derive(Module, Debug)]
pub struct DecoderLevel {
    /// The 4x4 deconvolution with stride 2.
    pub deconv: ConvTranspose2d,
    /// The normalisation before the deconvolution's ReLU (released reading).
    pub norm: Option<BatchNorm>,
    /// The 1x1 convolution of `[decoder | skips]` to the level's channels.
    pub fuse: Conv2d,
    /// Whether a ReLU follows the fusion.
    #[module(skip)]
    pub activated_fusion: bool,
}

impl DecoderLevel {
    fn build(
        b: &mut Builder,
        config: &ModelConfig,
        [below, channels]: [usize; 2],
        parts: usize,
    ) -> Result<Self, WeightsError> {
        let spec = config.reading.spec();
        Ok(DecoderLevel {
            deconv: b.part("deconv", |b| deconv4x4(b, [below, channels]))?,
            norm: spec
                .normalised_decoder
                .then(|| b.part("norm", |b| norm(b, channels)))
                .transpose()?,
            fuse: b.part("fuse", |b| skip_fusion(b, [parts * channels, channels]))?,
            activated_fusion: spec.activated_fusion,
        })
    }

    /// Up-samples the maps of the level below and fuses the skips into them (Eq. 2).
    ///
    /// # Shapes
    /// `[B, below, H, W]` and skips `[B, K, 2H, 2W]` to `[B, K, 2H, 2W]`.
    pub fn forward(&self, below: Maps, skips: Vec<Maps>) -> Maps {
        let decoded = match &self.norm {
            Some(norm) => below
                .deconv4x4(&self.deconv, Activation::None)
                .batch_norm(norm, Activation::Relu),
            None => below.deconv4x4(&self.deconv, Activation::Relu),
        };
        let parts = std::iter::once(decoded).chain(skips).collect();
        let activation = if self.activated_fusion {
            Activation::Relu
        } else {
            Activation::None
        };
        Maps::fuse(parts, &self.fuse, activation)
    }
}
