//! The forward pass of a U-Net, level by level, large maps in bands of rows.
//!
//! At the full resolution only the input and the output are whole. A band of the encoder's first level is
//! pooled at once. A band of the decoder's last level is made from the map below and the input.

use std::ops::Range;

use burn::tensor::Tensor;
use demc_kernels::conv3x3::Tile;
use demc_kernels::{Grid, Isa, double, memory, pool};

use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::full_resolution::write_rows;
use super::images_of;
use super::pass::BandPlan;
use super::side_encoder::SideMaps;
use super::unet_pass::{ImagePlanes, UnetPass, folded, interleave};
use super::watch::{Cancelled, Observer, Watch};
use crate::config::COLOR_CHANNELS;
use crate::unet::{UNET_LEVELS, Unet};

/// As [`Unet::forward`], on the host without autodiff.
pub(crate) fn forward(
    network: &Unet,
    color: Tensor<4>,
    features: Tensor<4>,
    observer: &mut Observer,
) -> Result<Tensor<4>, Cancelled> {
    let [_, _, height, width] = color.dims();
    let input = Input::new(network, color, features);
    let decoder_and_encoders = 2 + usize::from(network.side.is_some());
    let pass = UnetPass {
        plan: BandPlan::new(width),
        tile: Tile::F4,
        watch: &Watch::new(input.color.grid, decoder_and_encoders, observer),
    };
    Ok(images_of(pass.forward(network, &input)?, height, width))
}

/// Colour and features.
struct Input {
    color: ImagePlanes,
    features: Option<ImagePlanes>,
    /// The first feature channel of each guide.
    guides: &'static [usize],
}

impl Input {
    fn new(network: &Unet, color: Tensor<4>, features: Tensor<4>) -> Self {
        let guides = network.guides().first_channels();
        let takes_features = !guides.is_empty() || network.side.is_some();
        Input {
            color: ImagePlanes::new(color),
            features: takes_features.then(|| ImagePlanes::new(features)),
            guides,
        }
    }

    /// Channels of colour and guides.
    fn channels(&self) -> usize {
        COLOR_CHANNELS * (1 + self.guides.len())
    }

    fn features(&self) -> &ImagePlanes {
        self.features.as_ref().expect("the network takes features")
    }

    /// Rows of colour and guides of an image, channels last.
    fn interleave(&self, image: usize, rows: Range<usize>, target: &mut [f32]) {
        let mut planes: Vec<&[f32]> = self.color.planes(image, 0..COLOR_CHANNELS).collect();
        for first in self.guides {
            planes.extend(
                self.features()
                    .planes(image, *first..first + COLOR_CHANNELS),
            );
        }
        interleave(&planes, self.color.grid.width, rows, target);
    }
}

impl UnetPass<'_> {
    /// Returns the planes of the images.
    fn forward(&self, network: &Unet, input: &Input) -> Result<Vec<f32>, Cancelled> {
        let grid = input.color.grid;
        let side = network.side.as_ref();
        let mut side = side
            .map(|encoder| SideMaps::new(self, encoder, input.features()))
            .transpose()?;
        // The input of each encoder level but the first, which is the skip of the decoder's.
        let mut skips: Vec<FeatureMaps> = Vec::with_capacity(UNET_LEVELS);
        for (level, module) in network.encoder.iter().enumerate() {
            let grid = (0..level).fold(grid, |grid, _| grid.halved());
            let convs = folded(module);
            let outputs = convs.last().expect("a convolution").outputs();
            let mut below = FeatureMaps::new(grid.halved(), outputs);
            self.run(
                &convs,
                grid,
                |image, rows, target| match skips.last() {
                    None => input.interleave(image, rows, target),
                    Some(maps) => target.copy_from_slice(maps.rows(image, rows)),
                },
                |conv, image, rows, values| {
                    if conv + 1 < convs.len() {
                        return;
                    }
                    let band = Grid {
                        batch: 1,
                        height: rows.len(),
                        ..grid
                    };
                    let target = below.rows_mut(image, rows.start / 2..rows.end / 2);
                    pool::forward(Isa::current(), band, values, target);
                },
            )?;
            skips.push(below);
        }
        let deepest = skips.pop().expect("four levels");
        let mut x = self.level(
            &folded(&network.bottom),
            deepest.grid,
            |image, rows, target| {
                target.copy_from_slice(deepest.rows(image, rows));
            },
            |_, _, _| (),
        )?;
        drop(deepest);
        let (last, upper) = network.decoder.split_last().expect("four levels");
        for (index, module) in upper.iter().enumerate() {
            let skip = skips.pop().expect("a skip for each level but the last");
            let (level, below) = (UNET_LEVELS - 1 - index, x);
            x = self.level(
                &folded(module),
                skip.grid,
                |image, rows, target| {
                    let appended = skip.rows(image, rows.clone());
                    append(&below, image, rows, skip.grid, appended, target);
                },
                |image, rows, values| {
                    if let Some(side) = &side {
                        side.fuse(level, image, rows, values);
                    }
                },
            )?;
            if let Some(side) = &mut side {
                side.free(level);
            }
        }
        let mut convs = folded(last);
        let head = convs.len();
        convs.push(FoldedConv::conv(&network.head, None));
        let mut planar = memory::buffer(grid.pixels() * COLOR_CHANNELS);
        let image_values = grid.height * grid.width * COLOR_CHANNELS;
        self.run(
            &convs,
            grid,
            |image, rows, target| {
                let mut skip = memory::buffer(rows.len() * grid.width * input.channels());
                input.interleave(image, rows.clone(), &mut skip);
                append(&x, image, rows, grid, &skip, target);
            },
            |conv, image, rows, values| {
                if conv == head {
                    let planar = &mut planar[image * image_values..][..image_values];
                    write_rows(planar, grid, rows, values);
                } else if conv + 1 == head
                    && let Some(side) = &side
                {
                    side.fuse(0, image, rows, values);
                }
            },
        )?;
        Ok(planar)
    }

    /// A level's whole output, whose rows `complete` may change.
    fn level(
        &self,
        convs: &[FoldedConv],
        grid: Grid,
        fill: impl FnMut(usize, Range<usize>, &mut [f32]),
        complete: impl Fn(usize, Range<usize>, &mut [f32]),
    ) -> Result<FeatureMaps, Cancelled> {
        let outputs = convs.last().expect("a convolution").outputs();
        let mut maps = FeatureMaps::new(grid, outputs);
        self.run(convs, grid, fill, |conv, image, rows, values| {
            if conv + 1 == convs.len() {
                complete(image, rows.clone(), values);
                maps.rows_mut(image, rows).copy_from_slice(values);
            }
        })?;
        Ok(maps)
    }
}

/// Rows of an image's input of a decoder level: the map below doubled, then `skip`, which has these rows.
fn append(
    below: &FeatureMaps,
    image: usize,
    rows: Range<usize>,
    grid: Grid,
    skip: &[f32],
    target: &mut [f32],
) {
    let band = Grid {
        batch: 1,
        height: rows.len(),
        ..grid
    };
    let coarse = below.rows(image, rows.start / 2..rows.end / 2);
    double::forward(band, coarse, skip, target);
}
