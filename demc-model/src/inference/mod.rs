//! The forward pass without autodiff, on slices of the host's memory, with little working memory.
//!
//! [`Denoiser::forward`](crate::Denoiser::forward) uses it where the kernels run without autodiff.
//! It computes what the modules define, but differs in how:
//!
//! - Batch normalisations are folded into the convolutions before them (`folded`).
//! - A skip fusion (Eq. 2) is linear before its ReLU. So the encoders' shares of it are summed into
//!   one map as soon as a level's skips are known. No skip is kept for the decoder, which adds its
//!   share in place.
//! - Large maps are computed in bands of rows (`band`). In the fusion sub-network and the encoders'
//!   upper levels, a band passes on while it is still in a cache (`encoder`). In the decoder, only
//!   a band of a level's input to the fusion is in memory (`decoder`).
//! - For a large image, no map of the full resolution is ever whole, except those of a few
//!   channels: input, detail map and output (`full_resolution`).
//! - 3x3 convolutions need a quarter of the plain sum's multiplications (Winograd, F(4x4, 3x3)).

mod band;
mod decoder;
mod encoder;
mod estimate;
mod feature_maps;
mod folded;
mod full_resolution;
mod images;
mod kernel_head;
mod pass;
mod side_encoder;
#[cfg(test)]
mod tests;
mod unet;
mod unet_estimate;
mod unet_pass;
mod watch;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::nn::conv::Conv2d;
use burn::tensor::{Tensor, TensorData};
use demc_kernels::conv3x3::Tile;
use demc_kernels::{Isa, grid, memory};

use crate::config::{COLOR_CHANNELS, LEVELS};
use crate::decoder::Decoder;
use crate::dual_encoder::DualEncoder;
use encoder::{DEEPEST_BANDED, folded_block};
use feature_maps::FeatureMaps;
use full_resolution::{SkipSources, UPPER_LEVELS};
use images::InputImages;
use kernel_head::{KernelHead, linear_images};
use pass::{BandPlan, InferencePass};
use watch::Watch;

pub use estimate::{pass_bytes, peak_bytes, reusable_bytes};
pub use folded::{FoldedConv, norm_scale};
pub(crate) use unet::forward as forward_unet;
pub use watch::{Cancelled, Observer};

pub(crate) fn forward(
    model: &DualEncoder,
    images: [Tensor<4>; 2],
    layers: Option<Tensor<4>>,
    observer: &mut Observer,
) -> Result<(Tensor<4>, Option<Tensor<4>>), Cancelled> {
    let plan = BandPlan::new(images[0].dims()[3]);
    forward_with(model, images, layers, Tile::F4, plan, observer)
}

/// The same with a given size of tiles and plan.
fn forward_with(
    model: &DualEncoder,
    [color_gamma, features_z]: [Tensor<4>; 2],
    layers: Option<Tensor<4>>,
    tile: Tile,
    plan: BandPlan,
    observer: &mut Observer,
) -> Result<(Tensor<4>, Option<Tensor<4>>), Cancelled> {
    let [batch, _, height, width] = color_gamma.dims();
    let takes_features = model.config().variant.spec().takes_features();
    let images = InputImages::new(color_gamma, takes_features.then_some(features_z));
    let grid = images.grid;
    let pass = InferencePass {
        isa: Isa::current(),
        tile,
        plan,
        model,
        watch: &Watch::new(grid, 2, observer),
    };
    let color = model.decoder.head.is_none().then(|| images.color());
    let encoded = pass.encode(images)?;
    let head = color.map(|color| {
        let images = linear_images(pass.isa, grid, &color, layers);
        let layers = images.grid.batch - batch;
        KernelHead::new(pass.isa, &model.decoder.kernels, images, layers)
    });
    let (out, layers) = pass.decode(encoded, head)?;
    let layers = layers.map(|layers| images_of(layers, height, width));
    Ok((images_of(out, height, width), layers))
}

/// Planes as a tensor `[B, 3, H, W]`.
fn images_of(planes: Vec<f32>, height: usize, width: usize) -> Tensor<4> {
    let batch = planes.len() / (COLOR_CHANNELS * height * width);
    let data = TensorData::new(planes, [batch, COLOR_CHANNELS, height, width]);
    Tensor::from_primitive::<Flex>(FlexTensor::from_data(data))
}

struct EncodedImages {
    /// The skips' share of each level's fusion, from the full resolution down; without the first
    /// level if `sources` holds its inputs.
    sums: Vec<FeatureMaps>,
    /// The inputs from which the first level's skips are recomputed.
    sources: Option<SkipSources>,
    /// The latent's input.
    bottom: FeatureMaps,
}

impl InferencePass<'_> {
    fn encode(&self, images: InputImages) -> Result<EncodedImages, Cancelled> {
        let (mut sums, mut sources) = (Vec::with_capacity(LEVELS), None);
        let (first, mut inputs) = if self.plan.is_banded(images.grid) {
            let upper = self.encode_upper_levels(images)?;
            sums.push(upper.sum);
            sources = Some(upper.sources);
            (UPPER_LEVELS, upper.below)
        } else {
            (0, self.encoder_inputs(images))
        };
        for level in first..LEVELS {
            let grid = inputs[0].grid;
            let banded = level <= DEEPEST_BANDED && self.plan.is_banded(grid);
            sums.push(if banded {
                self.encode_level_in_bands(level, &mut inputs)?
            } else {
                self.encode_level(level, &mut inputs)?
            });
        }
        let bottom = inputs.pop().expect("the last encoder feeds the latent");
        Ok(EncodedImages {
            sums,
            sources,
            bottom,
        })
    }

    /// The planes of the denoised images, and of the layers of a kernel head.
    fn decode(
        &self,
        encoded: EncodedImages,
        mut head: Option<KernelHead>,
    ) -> Result<(Vec<f32>, Option<Vec<f32>>), Cancelled> {
        let EncodedImages {
            sums,
            sources,
            bottom,
        } = encoded;
        let mut x = self.conv3x3(&bottom, &folded_block(&self.model.latent));
        drop(bottom);
        let decoder = &self.model.decoder;
        let levels = decoder.levels.iter().zip(sums.into_iter().rev());
        for (index, (level, sum)) in levels.enumerate() {
            x = self.decode_level(level, &x, sum)?;
            if let Some(head) = &mut head {
                head.filter_level(LEVELS - 1 - index, &x, self.plan.band);
            }
        }
        match (sources, head) {
            (Some(sources), head) => self.decode_full_resolution(&x, sources, head),
            (None, Some(head)) => Ok(head.finish()),
            (None, None) => {
                let image = self.conv3x3(&x, &FoldedConv::head(conv_head(decoder)));
                let mut planar = memory::buffer(image.values.len());
                grid::nchw_from_nhwc(image.grid, &image.values, &mut planar);
                Ok((planar, None))
            }
        }
    }
}

/// The output convolution of a network without a kernel head.
fn conv_head(decoder: &Decoder) -> &Conv2d {
    let head = decoder.head.as_ref();
    head.expect("a head is a convolution or kernels")
}
