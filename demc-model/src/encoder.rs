//! An encoder (Sec. 3.2): five levels of 3x3 convolutions, each followed by a 2x2 max-pooling, a skip taken at each.

use burn::module::Module;
use burn::nn::conv::Conv2d;

use crate::config::{LEVELS, ModelConfig};
use crate::init::Init;
use crate::layers::conv3x3;
use crate::ops::{Activation, Maps};
use crate::weights::{Builder, WeightsError};

/// Five levels, from the full resolution down.
#[derive(Module, Debug)]
pub struct Encoder {
    /// The levels.
    pub levels: Vec<EncoderLevel>,
}

/// What an encoder hands to the decoder.
#[derive(Debug)]
pub struct Encoded {
    /// One a level, `[B, K_i, H / 2^i, W / 2^i]` for i = 0..5, K_i the level's channels.
    pub skips: Vec<Maps>,
    /// What lies below the last level, `[B, K_5, H / 32, W / 32]`: the latent's input, where the encoder computes it.
    pub bottom: Option<Maps>,
}

impl Encoder {
    /// An encoder of `input` channels. Only one that `feeds_latent` has parameters after its last skip.
    pub(crate) fn build(
        b: &mut Builder,
        config: &ModelConfig,
        input: usize,
        feeds_latent: bool,
    ) -> Result<Self, WeightsError> {
        let spec = config.reading.spec();
        let channels = config.level_channels();
        let levels = b.list("levels", LEVELS, |b, i| {
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
    /// `[B, input, H, W]`, H and W multiples of 32, to [`Encoded`].
    pub fn forward(&self, image: Maps) -> Encoded {
        let mut skips = Vec::with_capacity(LEVELS);
        let mut x = Some(image);
        for level in &self.levels {
            let input = x.take().expect("only the last level has nothing below it");
            let (skip, below) = level.forward(input);
            skips.push(skip);
            x = below;
        }
        Encoded { skips, bottom: x }
    }
}

/// One down-sampling unit.
#[derive(Module, Debug)]
pub struct EncoderLevel {
    /// The convolutions, each followed by a ReLU.
    pub convs: Vec<Conv2d>,
    /// After how many of them the skip is taken.
    #[module(skip)]
    pub skip_after: usize,
    /// Whether anything lies below.
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
