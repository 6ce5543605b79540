//! The feature fusion sub-network (Sec. 3.2): twelve feature channels to a detail map of three
//! (Fig. 2 e).

use burn::module::Module;

use crate::config::{DETAIL_CHANNELS, Detail, FEATURE_CHANNELS};
use crate::init::{Init, OPEN_BIAS};
use crate::layers::ConvBlock;
use crate::ops::Maps;
use crate::weights::{Builder, WeightsError};

/// Four convolutional blocks; the two in the middle are batch normalised.
#[derive(Module, Debug)]
pub struct Fusion {
    /// The blocks, first to last.
    pub blocks: Vec<ConvBlock>,
}

impl Fusion {
    pub(crate) fn build(
        b: &mut Builder,
        width: usize,
        detail: Detail,
    ) -> Result<Self, WeightsError> {
        let bias = match detail {
            Detail::Open => Init::Color([OPEN_BIAS; DETAIL_CHANNELS]),
            Detail::Xavier => Init::Zeros,
        };
        let blocks = [
            ([FEATURE_CHANNELS, width], false, Init::Zeros),
            ([width, width], true, Init::Zeros),
            ([width, width], true, Init::Zeros),
            ([width, DETAIL_CHANNELS], false, bias),
        ];
        Ok(Fusion {
            blocks: b.list("blocks", blocks.len(), |b, i| {
                let (channels, normalised, bias) = blocks[i];
                ConvBlock::build(b, channels, normalised, bias)
            })?,
        })
    }

    /// The detail map of Z-scored features.
    ///
    /// # Shapes
    /// `[B, 12, H, W]` to `[B, 3, H, W]`.
    pub fn forward(&self, features_z: Maps) -> Maps {
        self.blocks
            .iter()
            .fold(features_z, |x, block| block.forward(x))
    }
}
