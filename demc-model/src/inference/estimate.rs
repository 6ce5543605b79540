//! How much memory a pass takes, told before it runs.

use demc_kernels::{Grid, memory};

use super::Plan;
use super::encoder::DEEPEST_BANDED;
use super::step::LEVELS_IN_STEP;
use crate::config::{
    COLOR_CHANNELS, DETAIL_CHANNELS, FEATURE_CHANNELS, Input, LEVELS, ModelConfig,
};

/// Bytes of a value.
const VALUE: usize = size_of::<f32>();

/// Places of a Winograd tile, F(4x4, 3x3).
const PLACES: usize = 36;

/// Pixels that it makes.
const TILE_PIXELS: usize = 16;

/// Most tiles that a thread transforms at a time where weights are large, which is where that is much memory.
const TILES: usize = 96;

/// Rows that wait for a next band, and that the last band of a chain brings beside its own.
const WAITING_ROWS: usize = 5;

/// The most bytes that denoising one image of `height` x `width` pixels takes where the kernels run, beside the network's
/// weights: the planar input and output, and all that [`Denoiser::forward`](crate::Denoiser::forward) holds at a time.
///
/// The pass is a sequence of phases; each holds some maps, the prepared weights of some convolutions and what threads
/// work in, and the largest counts. With `P` pixels, base width `C` and large images nearly all of it are the skips'
/// shares of the fusions, `C * P * (1/2 + 1/4 + 1/8 + 1/32)` values, and the images, `6 * P` to `18 * P`. It grows a
/// little with the number of threads, whose bands are larger.
/// Both sides are multiples of 32.
pub fn peak_bytes(config: &ModelConfig, height: usize, width: usize) -> u64 {
    let plan = Plan::new(width);
    let grid = Grid {
        batch: 1,
        height,
        width,
    };
    let pass = Pass { config, plan, grid };
    let values = pass.encoders().max(pass.decoder());
    (values * VALUE) as u64
}

/// Bytes that this process holds, does not use, and will use for its next images before it asks the system for more.
pub fn reusable_bytes() -> u64 {
    memory::kept_bytes() as u64
}

/// A pass through the network; all sizes in values.
struct Pass<'a> {
    config: &'a ModelConfig,
    plan: Plan,
    /// The image's.
    grid: Grid,
}

impl Pass<'_> {
    fn grid_of(&self, level: usize) -> Grid {
        (0..level).fold(self.grid, |grid, _| grid.halved())
    }

    fn channels(&self, level: usize) -> usize {
        self.config.level_channels()[level]
    }

    /// The map of a level, its input or one of its convolutions.
    fn map(&self, level: usize) -> usize {
        self.grid_of(level).pixels() * self.channels(level)
    }

    /// A level's input.
    fn input(&self, level: usize) -> usize {
        match level {
            0 => self.grid.pixels() * self.first_input(),
            _ => self.grid_of(level).pixels() * self.channels(level - 1),
        }
    }

    /// Channels of the widest encoder's input.
    fn first_input(&self) -> usize {
        let inputs = self.config.variant.spec().encoders.iter();
        let channels = inputs.map(|parts| parts.iter().map(|part| part.channels()).sum());
        channels.max().unwrap_or(COLOR_CHANNELS)
    }

    fn encoder_count(&self) -> usize {
        self.config.variant.spec().encoders.len()
    }

    /// The planar images.
    fn images(&self) -> usize {
        self.grid.pixels() * (COLOR_CHANNELS + FEATURE_CHANNELS)
    }

    fn has_fusion(&self) -> bool {
        self.config.variant.spec().has_fusion()
    }

    /// The detail map, where there is one.
    fn detail(&self) -> usize {
        match self.has_fusion() {
            true => self.grid.pixels() * DETAIL_CHANNELS,
            false => 0,
        }
    }

    /// What the first level's skips are computed from once more.
    fn kept(&self) -> usize {
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

    /// The shares of some levels' fusions; the first level's is not kept of a large image.
    fn sums(&self, levels: std::ops::Range<usize>) -> usize {
        let first = usize::from(self.plan.is_banded(self.grid));
        let levels = levels.filter(|level| *level >= first);
        levels.map(|level| self.map(level)).sum()
    }

    /// What threads work in at a convolution of `pixels`.
    fn scratch(&self, inputs: usize, outputs: usize, pixels: usize) -> usize {
        let tiles = (pixels / TILE_PIXELS).min(self.plan.threads * TILES);
        // Narrow ones work in less than a cache.
        match inputs * outputs * PLACES > 512 << 10 {
            true => PLACES * (inputs + outputs) * tiles,
            false => 0,
        }
    }

    /// The prepared weights of a level's convolutions: all, or the largest.
    fn weights(&self, level: usize, all: bool) -> usize {
        let (from, to) = match level {
            0 => (0, self.channels(0)),
            _ => (self.channels(level - 1), self.channels(level)),
        };
        let others = self.config.reading.spec().convolutions[level] - 1;
        match all {
            true => PLACES * to * (from + others * to),
            false => PLACES * to * to,
        }
    }

    /// Rows of a level of an image that a chain of convolutions holds while a band runs through.
    fn rows(&self, level: usize, rows: usize) -> usize {
        let Grid { height, width, .. } = self.grid_of(level);
        rows.min(height) * width * self.channels(level)
    }

    fn encoders(&self) -> usize {
        let count = self.encoder_count();
        let banded = |level| self.plan.is_banded(self.grid_of(level));
        let in_step = banded(0);
        let (first, mut most) = if in_step {
            let waiting: usize = (0..LEVELS_IN_STEP)
                .map(|level| {
                    let convolutions = self.config.reading.spec().convolutions[level];
                    self.rows(level, WAITING_ROWS) * (convolutions - 1) + self.weights(level, true)
                })
                .sum();
            let below = self.input(LEVELS_IN_STEP);
            // A band in and out of a convolution.
            let bands = 2 * self.rows(0, self.plan.band + 2 * WAITING_ROWS);
            let sums = self.sums(1..LEVELS_IN_STEP);
            let held = self.images() + self.detail() + sums + bands;
            (LEVELS_IN_STEP, held + count * (waiting + below))
        } else if self.has_fusion() {
            let fusion = 2 * self.map(0) + self.weights(0, false);
            (0, self.images() + fusion)
        } else {
            (0, self.images() + count * self.input(0))
        };
        for level in first..LEVELS {
            let held = self.kept() + self.sums(0..level + 1) + count * self.input(level);
            let grid = self.grid_of(level);
            let works = if level <= DEEPEST_BANDED && banded(level) {
                let bands = 3 * self.rows(level, self.plan.band + 2 * WAITING_ROWS);
                self.weights(level, true) + bands + self.input(level + 1)
            } else {
                let to = self.channels(level);
                let scratch = self.scratch(to, to, grid.pixels());
                // The input of the encoder at work goes with its first convolution.
                2 * self.map(level) - self.input(level) + self.weights(level, false) + scratch
            };
            most = most.max(held + works);
        }
        most
    }

    fn decoder(&self) -> usize {
        let all = self.sums(0..LEVELS);
        let bottom = self.map(LEVELS - 1) / 4;
        let deepest = self.channels(LEVELS - 1);
        let latent = PLACES * deepest * deepest + self.scratch(deepest, deepest, bottom / deepest);
        let mut most = all + 2 * bottom + latent;
        let in_step = self.plan.is_banded(self.grid);
        for level in (usize::from(in_step)..LEVELS).rev() {
            let grid = self.grid_of(level);
            let (to, below) = (self.channels(level), self.below(level));
            let from = self.channels((level + 1).min(LEVELS - 1));
            let share = match self.plan.is_banded(grid) {
                true => self.plan.band as f64 / grid.height as f64,
                false => 1.0,
            };
            // The decoded rows, and the rows below with their border.
            let works = (share * (self.map(level) + below) as f64) as usize;
            most = most.max(self.sums(0..level + 1) + below + works + 16 * from * to);
        }
        let output = self.grid.pixels() * COLOR_CHANNELS;
        let last = match in_step {
            true => {
                let waiting = self.encoder_count() * self.weights(0, false);
                self.below(0) + waiting + 3 * self.rows(0, self.plan.band + 2 * WAITING_ROWS)
            }
            // The head's products: 9 values an output, in whole vectors.
            false => self.map(0) + self.grid.pixels() * (32 + COLOR_CHANNELS),
        };
        self.kept() + most.max(output + last)
    }

    /// What the decoder has below a level.
    fn below(&self, level: usize) -> usize {
        match level + 1 {
            LEVELS => self.map(LEVELS - 1) / 4,
            below => self.map(below),
        }
    }
}
