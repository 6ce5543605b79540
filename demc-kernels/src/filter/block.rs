//! A block of pixels of a row: their values, their kernels, and their blend weights, one per lane.

use std::ops::Range;

use crate::Grid;
use crate::power::{exp, sigmoid};
use crate::scratch::Scratch;

/// Channels of the filtered image.
pub const COLORS: usize = 3;
/// Pixels of a row that are computed together, one per lane.
pub(super) const BLOCK: usize = 16;

/// One value for each pixel of a block.
type Lanes = [f32; BLOCK];

/// Some rows of an image with more pixels on each side, as far as a kernel reaches, each row as three
/// planes. Blocks may read beyond the row.
pub(super) struct PaddedRows {
    values: Scratch,
    /// Values of a plane of a row.
    stride: usize,
}

impl PaddedRows {
    pub(super) fn new(grid: Grid, x: &[f32], rows: Range<usize>, side: usize) -> Self {
        let reach = side / 2;
        let stride = grid.width.next_multiple_of(BLOCK) + 2 * reach;
        let mut values = Scratch::take((rows.len() + 2 * reach) * COLORS * stride);
        for (line, planes) in values.chunks_exact_mut(COLORS * stride).enumerate() {
            let row = (rows.start + line)
                .saturating_sub(reach)
                .min(grid.height - 1);
            let source = &x[row * grid.width * COLORS..(row + 1) * grid.width * COLORS];
            let (first, last) = (&source[..COLORS], &source[source.len() - COLORS..]);
            for (color, plane) in planes.chunks_exact_mut(stride).enumerate() {
                let (before, rest) = plane.split_at_mut(reach);
                let (own, after) = rest.split_at_mut(grid.width);
                before.fill(first[color]);
                after.fill(last[color]);
                let source = source[color..].iter().step_by(COLORS);
                own.iter_mut()
                    .zip(source)
                    .for_each(|(to, from)| *to = *from);
            }
        }
        PaddedRows { values, stride }
    }

    /// A colour of the pixels from (`line`, `column`) on, counted from the padding's corner.
    #[inline(always)]
    pub(super) fn lanes(&self, line: usize, color: usize, column: usize) -> &Lanes {
        let first = (line * COLORS + color) * self.stride + column;
        let lanes = self.values[first..first + BLOCK].try_into();
        lanes.expect("a block's length")
    }
}

/// The kernels of the pixels of a block: the softmax of their first logits, tap by tap.
#[inline(always)]
pub(super) fn kernels_of<const TAPS: usize>(logits: &[f32], channels: usize) -> [Lanes; TAPS] {
    let mut kernels = [[0.0; BLOCK]; TAPS];
    for (pixel, logits) in logits.chunks_exact(channels).enumerate() {
        for (tap, logit) in kernels.iter_mut().zip(logits) {
            tap[pixel] = *logit;
        }
    }
    let mut largest = [f32::NEG_INFINITY; BLOCK];
    for tap in &kernels {
        for (largest, logit) in largest.iter_mut().zip(tap) {
            *largest = if *logit > *largest { *logit } else { *largest };
        }
    }
    let mut sum = [0.0; BLOCK];
    for tap in &mut kernels {
        for ((weight, largest), sum) in tap.iter_mut().zip(&largest).zip(&mut sum) {
            *weight = exp(*weight - largest);
            *sum += *weight;
        }
    }
    let inverse = sum.map(|sum| 1.0 / sum);
    for tap in &mut kernels {
        for (weight, inverse) in tap.iter_mut().zip(&inverse) {
            *weight *= inverse;
        }
    }
    kernels
}

/// The blend weights of the pixels of a block: the sigmoid of the logits after their kernels', if there
/// is one.
#[inline(always)]
pub(super) fn blends_of<const TAPS: usize>(logits: &[f32], channels: usize) -> Lanes {
    let mut blends = [0.0; BLOCK];
    if channels > TAPS {
        let logits = logits.chunks_exact(channels);
        for (blend, logits) in blends.iter_mut().zip(logits) {
            *blend = logits[TAPS];
        }
        for blend in &mut blends {
            *blend = sigmoid(*blend);
        }
    }
    blends
}
