//! The forward pass where nothing is differentiated: on slices of the host's memory, with as little of it as possible.
//!
//! [`Denoiser::forward`](crate::Denoiser::forward) comes here by itself where the kernels run without autodiff. What it
//! computes is what the modules say; how it does so differs in this:
//!
//! - Batch normalisations are folded into the convolutions before them (`layer`).
//! - A skip fusion (Eq. 2) is linear before its ReLU. So the encoders' share of it is added up as soon as a level's skips
//!   are there, into one map of the level's width; no skip lives on until the decoder, which adds its own share in place.
//! - Large maps come in bands of rows (`band`): the fusion sub-network and the encoders' upper levels hand theirs on
//!   while they are still in a cache, and of a decoder's level only a band is not yet fused (`encoder`, `decoder`).
//! - No map of a large image's full resolution is ever whole but three channels in, three between and three out (`step`).
//! - 3x3 convolutions multiply four times less than the plain sum (Winograd, F(4x4, 3x3)).

mod band;
mod decoder;
mod encoder;
mod estimate;
mod images;
mod layer;
mod step;
#[cfg(test)]
mod tests;

use std::ops::Range;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::tensor::{Tensor, TensorData};
use demc_kernels::conv3x3::{self, Tile};
use demc_kernels::{Grid, Isa, grid, memory};

use crate::config::{COLOR_CHANNELS, LEVELS};
use crate::denoiser::Denoiser;
use crate::ops::Ops;
use band::TILE_ROWS;
use encoder::DEEPEST_BANDED;
use images::Images;
use step::{Again, LEVELS_IN_STEP};

pub use estimate::{peak_bytes, reusable_bytes};
pub use layer::{Layer, scale_of};

/// Pixels of the full resolution in a band, for each thread: enough work to wake threads for, little enough for caches.
const BAND_PIXELS: usize = 20 << 10;

/// Most rows of a band, however many threads there are: a large image is to come in bands on every machine.
const MOST_ROWS: usize = 256;

/// What a band's rows are a multiple of: a tile at the level below, too.
const BAND_STEP: usize = 2 * TILE_ROWS;

/// Whether an image on this tensor's device is denoised here.
pub(crate) fn applies(model: &Denoiser, image: &Tensor<4>) -> bool {
    let device = image.device();
    let plain = !device.is_autodiff() && !model.latent.conv.weight.val().device().is_autodiff();
    plain && model.ops().on(&device) == Ops::Kernels
}

/// As [`Denoiser::forward`], which has checked the shapes.
pub(crate) fn forward(
    model: &Denoiser,
    color_gamma: Tensor<4>,
    features_z: Tensor<4>,
) -> Tensor<4> {
    let plan = Plan::new(color_gamma.dims()[3]);
    forward_with(model, color_gamma, features_z, Tile::F4, plan)
}

/// The same with tiles of a given size and another plan.
fn forward_with(
    model: &Denoiser,
    color_gamma: Tensor<4>,
    features_z: Tensor<4>,
    tile: Tile,
    plan: Plan,
) -> Tensor<4> {
    let [batch, _, height, width] = color_gamma.dims();
    let run = Run {
        isa: Isa::current(),
        tile,
        plan,
        model,
    };
    let out = run.decode(run.encode(Images::new(color_gamma, features_z)));
    let shape = [batch, COLOR_CHANNELS, height, width];
    Tensor::from_primitive::<Flex>(FlexTensor::from_data(TensorData::new(out, shape)))
}

/// How an image is cut.
#[derive(Clone, Copy)]
struct Plan {
    /// Rows of a band. At every level a row is as many values and as much work where the channels double, as the paper's do, while the width halves.
    band: usize,
    /// Threads that share the work on a band.
    threads: usize,
}

impl Plan {
    /// For images of this width and the threads at hand.
    fn new(width: usize) -> Self {
        let threads = rayon::current_num_threads();
        let rows = BAND_PIXELS * threads / width;
        Plan {
            band: rows.clamp(1, MOST_ROWS).next_multiple_of(BAND_STEP),
            threads,
        }
    }

    /// Whether maps on `grid` come in bands: two bands or less save nothing.
    fn is_banded(self, grid: Grid) -> bool {
        grid.height > 2 * self.band
    }
}

/// One pass through the network.
struct Run<'a> {
    isa: Isa,
    tile: Tile,
    plan: Plan,
    model: &'a Denoiser,
}

/// What the encoders leave for the decoder.
struct Encoded {
    /// The skips' share of each level's fusion, from the full resolution down; without the first where it is `again`.
    sums: Vec<Maps>,
    /// What the first level's skips can be computed from once more.
    again: Option<Again>,
    /// The latent's input.
    bottom: Maps,
}

impl Run<'_> {
    /// All encoders, all levels.
    fn encode(&self, images: Images) -> Encoded {
        let (mut sums, mut again) = (Vec::with_capacity(LEVELS), None);
        let (first, mut inputs) = match self.plan.is_banded(images.grid) {
            true => {
                let step = self.descend_in_step(images);
                sums.push(step.sum);
                again = Some(step.again);
                (LEVELS_IN_STEP, step.below)
            }
            false => (0, self.inputs(images)),
        };
        for level in first..LEVELS {
            let grid = inputs[0].grid;
            let banded = level <= DEEPEST_BANDED && self.plan.is_banded(grid);
            sums.push(match banded {
                true => self.descend_in_bands(level, &mut inputs),
                false => self.descend(level, &mut inputs),
            });
        }
        let bottom = inputs.pop().expect("the last encoder feeds the latent");
        Encoded {
            sums,
            again,
            bottom,
        }
    }

    /// Planar images `[B, 3, H, W]` from what the encoders left.
    fn decode(&self, encoded: Encoded) -> Vec<f32> {
        let Encoded {
            sums,
            again,
            bottom,
        } = encoded;
        let latent = &self.model.latent;
        let mut x = self.conv3x3(&bottom, &Layer::conv(&latent.conv, latent.norm.as_ref()));
        drop(bottom);
        let decoder = &self.model.decoder;
        for (level, sum) in decoder.levels.iter().zip(sums.into_iter().rev()) {
            x = self.ascend(level, &x, sum);
        }
        match again {
            Some(again) => self.finish_in_step(&x, again),
            None => {
                let image = self.conv3x3(&x, &Layer::conv(&decoder.head, None));
                let mut planar = memory::buffer(image.values.len());
                grid::nchw_from_nhwc(image.grid, &image.values, &mut planar);
                planar
            }
        }
    }

    /// A convolution with its ReLU, of whole maps.
    fn conv3x3(&self, x: &Maps, layer: &Layer) -> Maps {
        let mut y = Maps::new(x.grid, layer.outputs());
        let conv = conv3x3::Ready::new(self.isa, self.tile, layer.weight(), layer.bias(), true);
        conv.forward(x.grid, &x.values, 0, &mut y.values);
        y
    }
}

/// Feature maps of a batch, channels last.
struct Maps {
    grid: Grid,
    values: Vec<f32>,
}

impl Maps {
    /// With whatever values.
    fn new(grid: Grid, channels: usize) -> Self {
        Maps {
            grid,
            values: memory::buffer(grid.pixels() * channels),
        }
    }

    fn channels(&self) -> usize {
        self.values.len() / self.grid.pixels()
    }

    /// The grid of some rows of one image.
    fn band(&self, rows: usize) -> Grid {
        Grid {
            batch: 1,
            height: rows,
            ..self.grid
        }
    }

    /// Some rows of an image.
    fn rows(&self, image: usize, rows: Range<usize>) -> &[f32] {
        &self.values[self.place(image, rows)]
    }

    fn rows_mut(&mut self, image: usize, rows: Range<usize>) -> &mut [f32] {
        let place = self.place(image, rows);
        &mut self.values[place]
    }

    fn place(&self, image: usize, rows: Range<usize>) -> Range<usize> {
        let row = self.grid.width * self.channels();
        let first = image * self.grid.height;
        (first + rows.start) * row..(first + rows.end) * row
    }

    /// These rows with one more on each side where there is one, and how many there are above.
    fn with_neighbours(&self, rows: Range<usize>) -> (Range<usize>, usize) {
        let start = rows.start.saturating_sub(1);
        (
            start..(rows.end + 1).min(self.grid.height),
            rows.start - start,
        )
    }
}
