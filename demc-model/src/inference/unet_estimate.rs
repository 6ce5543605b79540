//! Memory of a pass of a U-Net.

use super::pass::{BandPlan, TILE_VALUES, VALUE, WAITING_ROWS};
use crate::config::{COLOR_CHANNELS, FEATURE_CHANNELS, Head, ModelConfig};
use crate::unet::{UNET_LEVELS, UnetSpec};

/// As [`peak_bytes`](super::peak_bytes), for a U-Net. Both sides are multiples of 16.
///
/// Each level is a phase. It holds the images, and the maps that it reads, writes, and keeps for later levels.
/// A band of its convolutions and their prepared weights come on top.
pub(super) fn unet_bytes(config: &ModelConfig, height: usize, width: usize, layers: usize) -> u64 {
    let estimate = UnetEstimate {
        spec: config.size.spec(),
        inputs: config.guides.channels(),
        plan: BandPlan::new(width),
        height,
        width,
    };
    let images = estimate.map(0, COLOR_CHANNELS + FEATURE_CHANNELS);
    let head = match config.head {
        // The noisy, the filtered, and the blended images of all scales, and the gate; the layers beside the
        // colour, and their planes.
        Head::Mixed => estimate.map(0, (4 + 5 * layers) * COLOR_CHANNELS + 1),
        Head::Grey | Head::Xavier | Head::Kernel => 0,
    };
    ((images + head + estimate.largest_phase()) * VALUE) as u64
}

struct UnetEstimate {
    spec: &'static UnetSpec,
    /// Channels of the network's input.
    inputs: usize,
    plan: BandPlan,
    height: usize,
    width: usize,
}

impl UnetEstimate {
    fn map(&self, level: usize, channels: usize) -> usize {
        (self.height >> level) * (self.width >> level) * channels
    }

    /// Channels of the input of an encoder level, or of the bottom.
    fn input(&self, level: usize) -> usize {
        match level {
            0 => self.inputs,
            _ => *self.spec.encoder[level - 1].last().expect("a convolution"),
        }
    }

    /// The maps that the decoder's levels from 1 to `last` append.
    fn skips(&self, last: usize) -> usize {
        (1..=last)
            .map(|level| self.map(level, self.input(level)))
            .sum()
    }

    /// A band of a level's convolutions, from the input on, and their weights.
    fn working(&self, level: usize, channels: &[usize]) -> usize {
        let height = self.height >> level;
        let rows = if height > 2 * self.plan.band {
            self.plan.band + 2 * WAITING_ROWS
        } else {
            height
        };
        let pairs = || channels.windows(2);
        let widest = pairs().map(|pair| pair[0] + pair[1]).max().unwrap_or(0);
        let weights: usize = pairs().map(|pair| pair[0] * pair[1] * TILE_VALUES).sum();
        rows * (self.width >> level) * widest + weights
    }

    fn largest_phase(&self) -> usize {
        let mut phases = Vec::new();
        for level in 0..UNET_LEVELS {
            let channels = [&[self.input(level)], self.spec.encoder[level]].concat();
            let below = self.map(level + 1, self.input(level + 1));
            phases.push(self.skips(level) + below + self.working(level, &channels));
        }
        let [first, second] = self.spec.bottom;
        let channels = [self.input(UNET_LEVELS), first, second];
        let bottom = self.working(UNET_LEVELS, &channels) + self.map(UNET_LEVELS, second);
        phases.push(self.skips(UNET_LEVELS) + bottom);
        let mut below = second;
        for (index, [first, second]) in self.spec.decoder.into_iter().enumerate() {
            let level = UNET_LEVELS - 1 - index;
            let mut channels = vec![below + self.input(level), first, second];
            let mut output = second;
            if level == 0 {
                channels.push(COLOR_CHANNELS);
                output = COLOR_CHANNELS;
            }
            let maps = self.skips(level) + self.map(level + 1, below) + self.map(level, output);
            phases.push(maps + self.working(level, &channels));
            below = second;
        }
        phases.into_iter().max().expect("nine phases")
    }
}
