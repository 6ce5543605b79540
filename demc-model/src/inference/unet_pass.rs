//! What the parts of a U-Net's pass have in common: planar images as rows, and chains of convolutions in bands.

use std::ops::Range;

use burn::backend::flex::FlexTensor;
use burn::tensor::Tensor;
use demc_kernels::conv3x3::{PreparedConvolution, Tile};
use demc_kernels::{Grid, Isa};
use rayon::prelude::*;

use super::band::{BandedConv, ConvChain, RowWindow, bands};
use super::folded::FoldedConv;
use super::images::host;
use super::pass::BandPlan;
use super::watch::{Cancelled, Watch};
use crate::layers::ConvStack;

/// Planar images of some channels.
pub(super) struct ImagePlanes {
    pub(super) grid: Grid,
    channels: usize,
    pub(super) planes: FlexTensor,
}

impl ImagePlanes {
    pub(super) fn new(images: Tensor<4>) -> Self {
        let [batch, channels, height, width] = images.dims();
        ImagePlanes {
            grid: Grid {
                batch,
                height,
                width,
            },
            channels,
            planes: host(images),
        }
    }

    /// The planes of some channels of an image.
    pub(super) fn planes(
        &self,
        image: usize,
        channels: Range<usize>,
    ) -> impl Iterator<Item = &[f32]> {
        let all = self.planes.storage::<f32>();
        let planes = all.chunks_exact(self.grid.height * self.grid.width);
        planes
            .skip(image * self.channels + channels.start)
            .take(channels.len())
    }

    /// Rows of some channels of an image, channels last.
    pub(super) fn interleave(
        &self,
        image: usize,
        rows: Range<usize>,
        channels: Range<usize>,
        target: &mut [f32],
    ) {
        let planes: Vec<&[f32]> = self.planes(image, channels).collect();
        interleave(&planes, self.grid.width, rows, target);
    }
}

/// Rows of planes of a width, channels last.
pub(super) fn interleave(planes: &[&[f32]], width: usize, rows: Range<usize>, target: &mut [f32]) {
    let lines = target.par_chunks_mut(width * planes.len()).enumerate();
    lines.for_each(|(line, target)| {
        let line = (rows.start + line) * width;
        for (channel, plane) in planes.iter().enumerate() {
            let pixels = target.chunks_exact_mut(planes.len());
            for (pixel, value) in pixels.zip(&plane[line..line + width]) {
                pixel[channel] = *value;
            }
        }
    });
}

pub(super) struct UnetPass<'a> {
    pub(super) plan: BandPlan,
    pub(super) tile: Tile,
    pub(super) watch: &'a Watch<'a, 'a>,
}

impl UnetPass<'_> {
    /// Runs convolutions with ReLU on bands of maps on `grid`: `fill` writes rows of an image's input,
    /// `take` gets the index of a convolution, and rows of its output for an image, which it may change.
    pub(super) fn run(
        &self,
        convs: &[FoldedConv],
        grid: Grid,
        mut fill: impl FnMut(usize, Range<usize>, &mut [f32]),
        mut take: impl FnMut(usize, usize, Range<usize>, &mut [f32]),
    ) -> Result<(), Cancelled> {
        let banded = convs.iter().map(|conv| {
            let prepared = PreparedConvolution::new(Isa::current(), self.tile, conv.rectified());
            BandedConv::new(prepared, grid)
        });
        let outputs = convs.last().expect("a convolution").outputs();
        let mut chain = ConvChain {
            convs: banded.collect(),
            output: RowWindow::new(grid, outputs),
        };
        let band = if self.plan.is_banded(grid) {
            self.plan.band
        } else {
            grid.height
        };
        for image in 0..grid.batch {
            chain.restart();
            for rows in bands(grid.height, band) {
                self.watch.add(rows.len() * grid.width)?;
                let target = chain.input().push(rows.len());
                fill(image, rows, target);
                chain.advance(|conv, rows, values| take(conv, image, rows, values));
                chain.output.free_all();
            }
        }
        Ok(())
    }
}

pub(super) fn folded(level: &ConvStack) -> Vec<FoldedConv> {
    let convs = level.convs.iter();
    convs.map(|conv| FoldedConv::conv(conv, None)).collect()
}
