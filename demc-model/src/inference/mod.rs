//! The forward pass where nothing is differentiated: on slices of the host's memory, with as little of it as possible.
//!
//! [`Denoiser::forward`](crate::Denoiser::forward) comes here by itself where the kernels run without autodiff. What it
//! computes is what the modules say; how it does so differs in this:
//!
//! - Batch normalisations are folded into the convolutions before them ([`layer`]).
//! - A skip fusion (Eq. 2) is linear before its ReLU. So the encoders' share of it is added up as soon as a level's skips
//!   are there, into one map of the level's width; no skip lives on until the decoder, which adds its own share in place.
//! - The encoders go down in step, level by level, so that their skips meet.
//! - 3x3 convolutions multiply four times less than the plain sum (Winograd, F(4x4, 3x3)).

mod layer;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::tensor::{Tensor, TensorData};
use demc_kernels::conv1x1::{self, Finish};
use demc_kernels::conv3x3::Tile;
use demc_kernels::{Grid, Isa, conv3x3, deconv4x4, grid, memory, pool};

use crate::config::{COLOR_CHANNELS, Input, LEVELS};
use crate::decoder::DecoderLevel;
use crate::denoiser::Denoiser;
use crate::ops::Ops;
use layer::Layer;

/// Whether an image on this tensor's device is denoised here.
pub(crate) fn applies(model: &Denoiser, image: &Tensor<4>) -> bool {
    let device = image.device();
    let plain = !device.is_autodiff() && !model.latent.conv.weight.val().device().is_autodiff();
    plain && model.ops().on(&device) == Ops::Kernels
}

/// As [`Denoiser::forward`], which has checked the shapes.
pub(crate) fn forward(model: &Denoiser, color_gamma: Tensor<4>, features_z: Tensor<4>) -> Tensor<4> {
    let [batch, _, height, width] = color_gamma.dims();
    let run = Run {
        isa: Isa::current(),
        tile: Tile::F4,
        model,
    };
    let grid = Grid {
        batch,
        height,
        width,
    };
    let out = run.denoise(grid, [color_gamma, features_z].map(host));
    let shape = [batch, COLOR_CHANNELS, height, width];
    Tensor::from_primitive::<Flex>(FlexTensor::from_data(TensorData::new(out, shape)))
}

fn host(tensor: Tensor<4>) -> FlexTensor {
    let tensor = tensor
        .try_into_primitive::<Flex>()
        .expect("an image on flex");
    tensor.to_contiguous()
}

/// One pass through the network.
struct Run<'a> {
    isa: Isa,
    tile: Tile,
    model: &'a Denoiser,
}

/// Feature maps, channels last.
struct Maps {
    grid: Grid,
    values: Vec<f32>,
}

impl Maps {
    fn new(grid: Grid, channels: usize) -> Self {
        Maps {
            grid,
            values: memory::buffer(grid.pixels() * channels),
        }
    }
}

impl Run<'_> {
    /// Planar `[B, 3, H, W]` from planar colour and features.
    fn denoise(&self, grid: Grid, images: [FlexTensor; 2]) -> Vec<f32> {
        let images = images.map(|image| {
            let planar = image.storage::<f32>();
            let mut maps = Maps::new(grid, planar.len() / grid.pixels());
            grid::nhwc_from_nchw(grid, planar, &mut maps.values);
            maps
        });
        let mut inputs = self.inputs(images);
        let mut skips = Vec::with_capacity(LEVELS);
        for level in 0..LEVELS {
            skips.push(self.encode(level, &mut inputs));
        }
        let bottom = inputs.pop().expect("the last encoder feeds the latent");
        let latent = &self.model.latent;
        let mut x = self.conv3x3(&bottom, &Layer::conv(&latent.conv, latent.norm.as_ref()));
        drop(bottom);
        for (level, sum) in self.model.decoder.levels.iter().zip(skips.into_iter().rev()) {
            x = self.decode(level, &x, sum);
        }
        let image = self.conv3x3(&x, &Layer::conv(&self.model.decoder.head, None));
        let mut planar = x.values;
        planar.truncate(image.values.len());
        grid::nchw_from_nhwc(grid, &image.values, &mut planar);
        planar
    }

    /// What each encoder eats.
    fn inputs(&self, [color, features]: [Maps; 2]) -> Vec<Maps> {
        let detail = self.model.fusion.as_ref().map(|fusion| {
            let [first, rest @ ..] = &fusion.blocks[..] else {
                panic!("a fusion of no block")
            };
            let first = self.conv3x3(&features, &Layer::conv(&first.conv, first.norm.as_ref()));
            rest.iter().fold(first, |x, block| {
                self.conv3x3(&x, &Layer::conv(&block.conv, block.norm.as_ref()))
            })
        });
        let image = |input: &Input| match input {
            Input::Color => &color,
            Input::Features => &features,
            Input::DetailMap => detail.as_ref().expect("a variant with a fusion"),
        };
        let spec = self.model.config().variant.spec();
        spec.encoders
            .iter()
            .map(|inputs| cat(&inputs.iter().map(image).collect::<Vec<_>>()))
            .collect()
    }

    /// Takes all encoders down a level: their inputs become those of the level below. Returns the skips' share of the
    /// level's fusion.
    fn encode(&self, level: usize, inputs: &mut Vec<Maps>) -> Maps {
        let encoders = &self.model.encoders;
        let grid = inputs[0].grid;
        let mut skips = Vec::with_capacity(encoders.len());
        for (encoder, input) in encoders.iter().zip(std::mem::take(inputs)) {
            let level = &encoder.levels[level];
            let mut x = input;
            for conv in &level.convs[..level.skip_after] {
                x = self.conv3x3(&x, &Layer::conv(conv, None));
            }
            let skip = x;
            if level.pooled {
                let mut last = None;
                for conv in &level.convs[level.skip_after..] {
                    let x = last.as_ref().unwrap_or(&skip);
                    last = Some(self.conv3x3(x, &Layer::conv(conv, None)));
                }
                inputs.push(self.max_pool(last.as_ref().unwrap_or(&skip)));
            }
            skips.push(skip);
        }
        let fuse = Layer::conv(&self.model.decoder.levels[LEVELS - 1 - level].fuse, None);
        let mut sum = Maps::new(grid, fuse.outputs());
        let skips: Vec<&[f32]> = skips.iter().map(|skip| &skip.values[..]).collect();
        let finish = Finish::default();
        conv1x1::part(self.isa, grid, &skips, fuse.weight(), fuse.outputs(), finish, &mut sum.values);
        sum
    }

    /// A level of the decoder: `sum` is the skips' share of its fusion and becomes its output.
    fn decode(&self, level: &DecoderLevel, below: &Maps, mut sum: Maps) -> Maps {
        let layer = Layer::deconv(&level.deconv, level.norm.as_ref());
        let mut decoded = Maps::new(sum.grid, layer.outputs());
        deconv4x4::forward(
            self.isa,
            below.grid,
            &below.values,
            layer.weight(),
            layer.bias(),
            true,
            &mut decoded.values,
        );
        let fuse = Layer::conv(&level.fuse, None);
        let finish = Finish {
            bias: Some(fuse.bias()),
            relu: level.activated_fusion,
            add: true,
        };
        conv1x1::part(
            self.isa,
            sum.grid,
            &[&decoded.values],
            fuse.weight(),
            0,
            finish,
            &mut sum.values,
        );
        sum
    }

    fn conv3x3(&self, x: &Maps, layer: &Layer) -> Maps {
        let mut y = Maps::new(x.grid, layer.outputs());
        conv3x3::forward_with(
            self.isa,
            self.tile,
            x.grid,
            &x.values,
            layer.weight(),
            layer.bias(),
            true,
            &mut y.values,
        );
        y
    }

    fn max_pool(&self, x: &Maps) -> Maps {
        let mut y = Maps::new(x.grid.halved(), x.grid.channels(x.values.len()));
        pool::forward(self.isa, x.grid, &x.values, &mut y.values);
        y
    }
}

/// The channels of all parts, one after another.
fn cat(parts: &[&Maps]) -> Maps {
    let grid = parts[0].grid;
    let channels: Vec<usize> = parts.iter().map(|part| grid.channels(part.values.len())).collect();
    let total = channels.iter().sum();
    let mut all = Maps::new(grid, total);
    let mut first = 0;
    for (part, channels) in parts.iter().zip(channels) {
        let pixels = all.values.chunks_exact_mut(total);
        for (pixel, part) in pixels.zip(part.values.chunks_exact(channels)) {
            pixel[first..first + channels].copy_from_slice(part);
        }
        first += channels;
    }
    all
}
