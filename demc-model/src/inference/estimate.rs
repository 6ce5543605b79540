//! The memory of a pass, known before it runs.

use demc_kernels::{Grid, memory};

use super::encoder::DEEPEST_BANDED;
use super::full_resolution::UPPER_LEVELS;
use super::pass::{BandPlan, TILE_VALUES, VALUE, WAITING_ROWS};
use super::unet_estimate::unet_bytes;
use crate::config::{
    COLOR_CHANNELS, DETAIL_CHANNELS, FEATURE_CHANNELS, Head, Input, LEVELS, ModelConfig, Variant,
    channels_of,
};
use crate::kernel_head::{KERNEL_LEVELS, logits};
use crate::kpcn;
use crate::ops::Ops;

const TILE_PIXELS: usize = 16;

/// Largest number of tiles that a thread transforms at a time where weights, and so this memory,
/// are large.
const TILES: usize = 96;

/// Values that Burn's operations hold at a time per value of the largest map. Measured: 7 to 8 on
/// `flex` with width 16, the paper's levels and images from 256x256 to 1280x720.
const BURN_VALUES: u64 = 10;

/// Bytes that a pass of `ops` over one image of `height` x `width` pixels takes, without the
/// network's weights. Both sides are multiples of 32. `layers` is the number of images of three
/// channels that a kernel head filters beside the colour.
pub fn pass_bytes(
    ops: Ops,
    config: &ModelConfig,
    height: usize,
    width: usize,
    layers: usize,
) -> u64 {
    match config.variant {
        Variant::Kpcn => return kpcn_bytes(config, height * width),
        variant if variant.is_unet() && ops.has_fast_inference() => {
            return unet_bytes(config, height, width);
        }
        variant if variant.is_unet() => {
            let [.., [_, below], _] = config.size.spec().decoder;
            let channels = below + config.guides.channels();
            return BURN_VALUES * (channels * height * width * VALUE) as u64;
        }
        _ => (),
    }
    if ops.has_fast_inference() {
        return peak_bytes(config, height, width, layers);
    }
    // The largest map is the fusion sub-network's or a level's; each level has a quarter of the
    // pixels.
    let levels = config.level_channels().into_iter().enumerate();
    let maps = levels.map(|(level, channels)| (channels * height * width) >> (2 * level));
    let largest = maps.fold(config.width * height * width, usize::max);
    let layers = layers * COLOR_CHANNELS * height * width;
    BURN_VALUES * ((largest + layers) * VALUE) as u64
}

/// Memory in bytes of a pass of KPCN. The logits of a network are whole: at its last convolution there
/// are also the input of it, the same with a border, and the images.
fn kpcn_bytes(config: &ModelConfig, pixels: usize) -> u64 {
    let images = 3 * Variant::Kpcn.spec().color_channels + 3 * FEATURE_CHANNELS;
    let values = images + 2 * config.width + kpcn::KERNEL_LOGITS;
    (values * pixels * VALUE) as u64
}

/// Peak memory in bytes of a pass of the kernels over one image of `height` x `width` pixels, with
/// `layers` as for [`pass_bytes`]. Both sides are multiples of 32.
///
/// It counts the planar input and output and the working memory of
/// [`Denoiser::forward`](crate::Denoiser::forward), but not the network's weights.
///
/// The pass is a sequence of phases. Each holds some maps, the prepared weights of some
/// convolutions and the working memory of the threads; the largest phase counts. A large image with
/// `P` pixels and base width `C` mostly needs the skips' shares of the fusions,
/// `C * P * (1/2 + 1/4 + 1/8 + 1/32)` values, and the images, `6 * P` to `18 * P` values. Bands,
/// and so the result, grow a little with the number of threads.
pub fn peak_bytes(config: &ModelConfig, height: usize, width: usize, layers: usize) -> u64 {
    let plan = BandPlan::new(width);
    let grid = Grid {
        batch: 1,
        height,
        width,
    };
    let estimate = PeakEstimate {
        config,
        plan,
        grid,
        layers,
    };
    let values = estimate.encoders().max(estimate.decoder());
    (values * VALUE) as u64
}

/// Bytes that this process holds unused. The next images use them before it asks the system for
/// more.
pub fn reusable_bytes() -> u64 {
    memory::kept_bytes() as u64
}

struct PeakEstimate<'a> {
    config: &'a ModelConfig,
    plan: BandPlan,
    grid: Grid,
    /// Images of three channels that the kernel head filters beside the colour.
    layers: usize,
}

impl PeakEstimate<'_> {
    fn grid_of(&self, level: usize) -> Grid {
        (0..level).fold(self.grid, |grid, _| grid.halved())
    }

    fn channels(&self, level: usize) -> usize {
        self.config.level_channels()[level]
    }

    fn map(&self, level: usize) -> usize {
        self.grid_of(level).pixels() * self.channels(level)
    }

    fn input(&self, level: usize) -> usize {
        match level {
            0 => self.grid.pixels() * self.first_input(),
            _ => self.grid_of(level).pixels() * self.channels(level - 1),
        }
    }

    fn first_input(&self) -> usize {
        let inputs = self.config.variant.spec().encoders.iter();
        let channels = inputs.map(|inputs| channels_of(inputs));
        channels.max().unwrap_or(COLOR_CHANNELS)
    }

    fn encoder_count(&self) -> usize {
        self.config.variant.spec().encoders.len()
    }

    fn images(&self) -> usize {
        let features = if self.config.variant.spec().takes_features() {
            FEATURE_CHANNELS
        } else {
            0
        };
        self.grid.pixels() * (COLOR_CHANNELS + features)
    }

    fn has_fusion(&self) -> bool {
        self.config.variant.spec().has_fusion()
    }

    fn detail(&self) -> usize {
        if self.has_fusion() {
            self.grid.pixels() * DETAIL_CHANNELS
        } else {
            0
        }
    }

    /// The inputs from which the first level's skips are recomputed.
    fn skip_sources(&self) -> usize {
        if !self.plan.is_banded(self.grid) {
            return 0;
        }
        let inputs = self.config.variant.spec().encoders.concat();
        let features = inputs.contains(&Input::Features);
        let images = if features {
            self.images()
        } else {
            self.grid.pixels() * COLOR_CHANNELS
        };
        images + self.detail()
    }

    /// The colour that a kernel head needs after the encoders; a large image's is kept anyway.
    fn kept_color(&self) -> usize {
        if self.config.head == Head::Kernel && !self.plan.is_banded(self.grid) {
            self.grid.pixels() * COLOR_CHANNELS
        } else {
            0
        }
    }

    /// The planes of the layers, until the kernel head has them channels last.
    fn layers(&self) -> usize {
        self.grid.pixels() * COLOR_CHANNELS * self.layers
    }

    /// The images that a kernel head filters.
    fn filtered_images(&self) -> usize {
        1 + self.layers
    }

    /// The skips' shares of some levels' fusions. For a large image the first level's share is not
    /// kept.
    fn sums(&self, levels: std::ops::Range<usize>) -> usize {
        let first = usize::from(self.plan.is_banded(self.grid));
        let levels = levels.filter(|level| *level >= first);
        levels.map(|level| self.map(level)).sum()
    }

    /// Working memory of the threads during a convolution with `pixels`.
    fn scratch(&self, inputs: usize, outputs: usize, pixels: usize) -> usize {
        let tiles = (pixels / TILE_PIXELS).min(self.plan.threads * TILES);
        // Narrow convolutions need less than a cache.
        if inputs * outputs * TILE_VALUES > 512 << 10 {
            TILE_VALUES * (inputs + outputs) * tiles
        } else {
            0
        }
    }

    /// The prepared weights of all convolutions of a level. The few input channels of the first do
    /// not count.
    fn all_weights(&self, level: usize) -> usize {
        let (inputs, outputs) = match level {
            0 => (0, self.channels(0)),
            _ => (self.channels(level - 1), self.channels(level)),
        };
        let others = self.config.reading.spec().convolutions[level] - 1;
        TILE_VALUES * outputs * (inputs + others * outputs)
    }

    fn largest_weights(&self, level: usize) -> usize {
        TILE_VALUES * self.channels(level) * self.channels(level)
    }

    fn rows(&self, level: usize, rows: usize) -> usize {
        let Grid { height, width, .. } = self.grid_of(level);
        rows.min(height) * width * self.channels(level)
    }

    fn encoders(&self) -> usize {
        let count = self.encoder_count();
        let banded = |level| self.plan.is_banded(self.grid_of(level));
        let (first, mut most) = if banded(0) {
            let waiting: usize = (0..UPPER_LEVELS)
                .map(|level| {
                    let convolutions = self.config.reading.spec().convolutions[level];
                    self.rows(level, WAITING_ROWS) * (convolutions - 1) + self.all_weights(level)
                })
                .sum();
            let below = self.input(UPPER_LEVELS);
            // The band before and after a convolution.
            let bands = 2 * self.rows(0, self.plan.band + 2 * WAITING_ROWS);
            let sums = self.sums(1..UPPER_LEVELS);
            let held = self.images() + self.detail() + sums + bands;
            (UPPER_LEVELS, held + count * (waiting + below))
        } else if self.has_fusion() {
            let fusion = 2 * self.map(0) + self.largest_weights(0);
            (0, self.images() + fusion)
        } else {
            (0, self.images() + count * self.input(0))
        };
        for level in first..LEVELS {
            let held = self.skip_sources()
                + self.kept_color()
                + self.sums(0..level + 1)
                + count * self.input(level);
            let grid = self.grid_of(level);
            let working = if level <= DEEPEST_BANDED && banded(level) {
                let bands = 3 * self.rows(level, self.plan.band + 2 * WAITING_ROWS);
                self.all_weights(level) + bands + self.input(level + 1)
            } else {
                let channels = self.channels(level);
                let scratch = self.scratch(channels, channels, grid.pixels());
                // The input of the current encoder is freed after its first convolution.
                2 * self.map(level) - self.input(level) + self.largest_weights(level) + scratch
            };
            most = most.max(held + working);
        }
        most + self.layers()
    }

    fn decoder(&self) -> usize {
        let all = self.sums(0..LEVELS);
        let bottom = self.map(LEVELS - 1) / 4;
        let deepest = self.channels(LEVELS - 1);
        let scratch = self.scratch(deepest, deepest, bottom / deepest);
        let latent = TILE_VALUES * deepest * deepest + scratch;
        let mut most = all + 2 * bottom + latent;
        let is_large = self.plan.is_banded(self.grid);
        for level in (usize::from(is_large)..LEVELS).rev() {
            let grid = self.grid_of(level);
            let below = self.below(level);
            let weights = 16 * self.config.channels_below(level) * self.channels(level);
            let share = if self.plan.is_banded(grid) {
                self.plan.band as f64 / grid.height as f64
            } else {
                1.0
            };
            // The decoded rows, and the rows of the level below with their border.
            let working = (share * (self.map(level) + below) as f64) as usize;
            let sums = self.sums(0..level + 1);
            most = most.max(sums + below + working + weights);
            most = most.max(sums + self.filter(level));
        }
        let output = self.grid.pixels() * COLOR_CHANNELS;
        let bands = self.below(0)
            + self.encoder_count() * self.largest_weights(0)
            + 3 * self.rows(0, self.plan.band + 2 * WAITING_ROWS);
        let last = match (is_large, self.config.head) {
            (true, Head::Kernel) => {
                let filtered = self.grid.pixels() * (COLOR_CHANNELS + 1) * self.filtered_images();
                (self.below(0) + self.filter(0)).max(bands + filtered)
            }
            (false, Head::Kernel) => self.map(0) + self.filter(0),
            (true, _) => output + bands,
            // The head's products: 9 values per output, in whole vectors.
            (false, _) => output + self.map(0) + self.grid.pixels() * (32 + COLOR_CHANNELS),
        };
        self.skip_sources() + self.scales() + most.max(last)
    }

    /// The scales of the noisy image that a kernel head filters.
    fn scales(&self) -> usize {
        let levels = (0..KERNEL_LEVELS).map(|level| self.grid_of(level).pixels());
        match self.config.head {
            Head::Kernel => {
                let values: usize = levels.map(|pixels| pixels * COLOR_CHANNELS).sum();
                values * self.filtered_images()
            }
            Head::Grey | Head::Xavier => 0,
        }
    }

    /// Working memory of a kernel head at a level. It has the filtered image with its blend weight
    /// and the output below; then either the logits of a band, or the blend and its correction.
    fn filter(&self, level: usize) -> usize {
        if self.config.head != Head::Kernel || level >= KERNEL_LEVELS {
            return 0;
        }
        let Grid { height, width, .. } = self.grid_of(level);
        let pixels = height * width;
        let logits = self.plan.band.min(height) * width * logits(level);
        let images = self.filtered_images();
        let below = images * pixels / 4 * COLOR_CHANNELS;
        let blend = images * pixels * COLOR_CHANNELS + below;
        images * pixels * (COLOR_CHANNELS + 1) + below + logits.max(blend)
    }

    fn below(&self, level: usize) -> usize {
        match level + 1 {
            LEVELS => self.map(LEVELS - 1) / 4,
            below => self.map(below),
        }
    }
}
