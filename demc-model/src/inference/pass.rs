//! A pass over a batch of images, and the bands that it computes large maps in.

use demc_kernels::conv3x3::{PreparedConvolution, Tile};
use demc_kernels::{Grid, Isa};

use super::band::TILE_ROWS;
use super::feature_maps::FeatureMaps;
use super::folded::FoldedConv;
use super::watch::Watch;
use crate::dual_encoder::DualEncoder;

/// Rows that a convolution keeps for the next band, and that the last band of a chain has beside
/// its own.
pub(super) const WAITING_ROWS: usize = 5;

/// Bytes of a value.
pub(super) const VALUE: usize = size_of::<f32>();

/// Values of a transformed Winograd tile, F(4x4, 3x3).
pub(super) const TILE_VALUES: usize = 36;

/// Pixels of the full resolution in a band, per thread: enough work for a thread, little enough for
/// caches.
const BAND_PIXELS: usize = 20 << 10;

/// Largest number of rows of a band, so that a large image is computed in bands on every machine.
const MOST_ROWS: usize = 256;

/// The rows of a band are a multiple of this: of a tile, at the level below, too.
const BAND_STEP: usize = 2 * TILE_ROWS;

/// The bands of a pass.
#[derive(Clone, Copy)]
pub(super) struct BandPlan {
    /// Rows of a band at every level. With the paper's levels, where channels double and the width
    /// halves, a row has the same number of values at every level.
    pub(super) band: usize,
    pub(super) threads: usize,
}

impl BandPlan {
    /// The plan for images of this width with the current number of threads.
    pub(super) fn new(width: usize) -> Self {
        let threads = rayon::current_num_threads();
        let rows = BAND_PIXELS * threads / width;
        BandPlan {
            band: rows.clamp(1, MOST_ROWS).next_multiple_of(BAND_STEP),
            threads,
        }
    }

    /// Whether maps on `grid` are computed in bands: two bands or fewer save nothing.
    pub(super) fn is_banded(self, grid: Grid) -> bool {
        grid.height > 2 * self.band
    }
}

/// A pass of a network.
pub(super) struct InferencePass<'a> {
    pub(super) isa: Isa,
    pub(super) tile: Tile,
    pub(super) plan: BandPlan,
    pub(super) model: &'a DualEncoder,
    pub(super) watch: &'a Watch<'a, 'a>,
}

impl InferencePass<'_> {
    /// A convolution of whole maps with a ReLU.
    pub(super) fn conv3x3(&self, x: &FeatureMaps, conv: &FoldedConv) -> FeatureMaps {
        let mut y = FeatureMaps::new(x.grid, conv.outputs());
        let prepared = PreparedConvolution::new(self.isa, self.tile, conv.rectified());
        prepared.forward(x.grid, &x.values, 0, &mut y.values);
        y
    }
}
