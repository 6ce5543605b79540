//! The kernel-predicting head (Bako et al. 2017; several scales: Vogels et al. 2018).
//!
//! `x_0` is the noisy colour in linear light (divided by the albedo with demodulation), `x_l` its 2x2
//! mean at level l = 0 to 3. `d_l` is the decoder's map at that resolution.
//!
//! - A 1x1 convolution of `d_l` gives 25 logits, and for l below 3 the logit of the blend weight
//!   `b_l`.
//! - `y_l`: each pixel of `x_l` filtered with the softmax of its 25 logits, a 5x5 kernel.
//! - `o_3 = y_3`, `o_l = y_l + b_l U(o_(l+1) - D(y_l))`, D the 2x2 mean, U the bilinear doubling.
//! - The output is `o_0` in gamma space, where it is above [`DARKEST`], else 0.
//!
//! For given kernels, `o_0` is linear in `x_0`: a flat image stays flat, and brightness is kept. So the
//! kernels filter other images of the same view, too ([`crate::Denoiser::forward_with_layers`]): where
//! layers add up to the colour, the denoised ones add up to `o_0`.

use burn::nn::conv::Conv2d;

use crate::layers::conv1x1;
use crate::ops::Maps;
use crate::weights::{Builder, Stage, WeightsError};

/// Levels with kernels, from the full resolution down.
pub const KERNEL_LEVELS: usize = 4;

/// Logits of a kernel.
pub const KERNEL_LOGITS: usize = 25;

/// Exponent of the colour compression (Eq. 4) that this head undoes: `data.gamma` must be this.
pub const GAMMA: f32 = 2.2;

/// Smaller outputs, in linear light, count as black. It bounds the gradient of `x^(1/2.2)`.
pub const DARKEST: f32 = 1e-8;

/// Logits at a level: a kernel, and a blend weight except at the deepest level.
pub fn logits(level: usize) -> usize {
    KERNEL_LOGITS + usize::from(level + 1 < KERNEL_LEVELS)
}

/// The convolutions, deepest level first. They start with nearly equal weights of all pixels.
///
/// `channels`: those of the decoder's levels, from the full resolution down.
pub(crate) fn build(b: &mut Builder, channels: &[usize]) -> Result<Vec<Conv2d>, WeightsError> {
    b.list("kernels", KERNEL_LEVELS, |b, k| {
        let level = KERNEL_LEVELS - 1 - k;
        b.enter(Stage::Head { level });
        conv1x1(b, [channels[level], logits(level)])
    })
}

/// The denoised image, and the layers filtered with its kernels.
///
/// # Shapes
/// `decoded`: the decoder's maps, deepest first. Colour in gamma space `[B, 3, H, W]`, to the same.
/// Layers in linear light `[L, 3, H, W]`, for B = 1, to the same.
pub(crate) fn forward(
    kernels: &[Conv2d],
    decoded: Vec<Maps>,
    color_gamma: Maps,
    layers: Option<Maps>,
) -> (Maps, Option<Maps>) {
    let color = color_gamma.radiance(GAMMA);
    let (color, layers) = match layers {
        None => (filtered(kernels, decoded, color), None),
        Some(layers) => {
            let images = Maps::cat_images(vec![color, layers]);
            let (color, layers) = filtered(kernels, decoded, images).split_first();
            (color, Some(layers))
        }
    };
    (color.gamma(GAMMA, DARKEST), layers)
}

/// Images in linear light, filtered on all scales.
///
/// # Shapes
/// `decoded`: the decoder's maps, deepest first, of which the last [`KERNEL_LEVELS`] count. Images
/// `[B, 3, H, W]` to the same.
fn filtered(kernels: &[Conv2d], decoded: Vec<Maps>, images: Maps) -> Maps {
    let mut scales = vec![images];
    for _ in 1..KERNEL_LEVELS {
        scales.push(scales[scales.len() - 1].clone().halve());
    }
    let above = decoded.len() - KERNEL_LEVELS;
    let decoded = decoded.into_iter().skip(above);
    let mut out: Option<Maps> = None;
    for ((conv, decoded), image) in kernels.iter().zip(decoded).zip(scales.into_iter().rev()) {
        let filtered = image.filter(decoded.conv1x1(conv));
        out = Some(match out {
            None => filtered,
            Some(coarse) => filtered.blend(coarse),
        });
    }
    out.expect("a kernel head has levels")
}
