//! An encoder (Sec. 3.2): five levels of 3x3 convolutions with a skip and a 2x2 max-pooling each.

use burn::module::Module;
use burn::nn::conv::Conv2d;

use crate::config::{LEVELS, ModelConfig};
use crate::init::Init;
use crate::layers::conv3x3;
use crate::ops::{Activation, Maps};
use crate::weights::{Builder, Stage, WeightsError};

/// Five levels, from the full resolution down.
#[derive(Module, Debug)]
pub struct Encoder {
    /// The levels.
    pub levels: Vec<EncoderLevel>,
}

/// The output of an encoder.
#[derive(Debug)]
pub struct EncoderOutput {
    /// One skip per level, `[B, K_i, H / 2^i, W / 2^i]` for i = 0..5, K_i the level's channels.
    pub skips: Vec<Maps>,
    /// The input of the latent, `[B, K_5, H / 32, W / 32]`, if this encoder computes it.
    pub bottom: Option<Maps>,
}

impl Encoder {
    /// The encoder with index `encoder` in the table of variants, for `input` channels. Only the
    /// last encoder feeds the latent; the others have no parameters after their last skip.
    pub(crate) fn build(
        b: &mut Builder,
        config: &ModelConfig,
        encoder: usize,
        input: usize,
    ) -> Result<Self, WeightsError> {
        let spec = config.reading.spec();
        let channels = config.level_channels();
        let feeds_latent = encoder + 1 == config.variant.spec().encoders.len();
        let levels = b.list("levels", LEVELS, |b, i| {
            b.enter(Stage::Encoder { encoder, level: i });
            let skip_after = spec.skip_after[i];
            let pooled = feeds_latent || i + 1 < LEVELS;
            let count = if pooled {
                spec.convolutions[i]
            } else {
                skip_after
            };
            let convs = b.list("convs", count, |b, j| {
                let from = match (i, j) {
                    (0, 0) => input,
                    (_, 0) => channels[i - 1],
                    _ => channels[i],
                };
                conv3x3(b, [from, channels[i]], Init::Xavier(1.0), Init::Zeros)
            })?;
            Ok(EncoderLevel {
                convs,
                skip_after,
                pooled,
            })
        })?;
        Ok(Encoder { levels })
    }

    /// Encodes an image.
    ///
    /// # Shapes
    /// `[B, input, H, W]`, H and W multiples of 32, to [`EncoderOutput`].
    pub fn forward(&self, image: Maps) -> EncoderOutput {
        let mut skips = Vec::with_capacity(LEVELS);
        let mut x = Some(image);
        for level in &self.levels {
            let input = x.take().expect("all levels but the last are pooled");
            let (skip, below) = level.forward(input);
            skips.push(skip);
            x = below;
        }
        EncoderOutput { skips, bottom: x }
    }
}

/// One down-sampling unit.
#[derive(Module, Debug)]
pub struct EncoderLevel {
    /// The convolutions, each followed by a ReLU.
    pub convs: Vec<Conv2d>,
    /// Number of convolutions before the skip.
    #[module(skip)]
    pub skip_after: usize,
    /// Whether the level has a max-pooling and a level below.
    #[module(skip)]
    pub pooled: bool,
}

impl EncoderLevel {
    /// The skip, and the pooled input of the level below.
    ///
    /// # Shapes
    /// `[B, in, H, W]` to `[B, K, H, W]` and `[B, K, H / 2, W / 2]`.
    pub fn forward(&self, x: Maps) -> (Maps, Option<Maps>) {
        let (before, after) = self.convs.split_at(self.skip_after);
        let skip = convolve(before, x);
        let below = self
            .pooled
            .then(|| convolve(after, skip.clone()).max_pool());
        (skip, below)
    }
}

fn convolve(convs: &[Conv2d], x: Maps) -> Maps {
    convs
        .iter()
        .fold(x, |x, conv| x.conv3x3(conv, Activation::Relu))
}
