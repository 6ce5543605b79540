//! Memory of a pass of a U-Net.

use super::pass::{BandPlan, TILE_VALUES, VALUE, WAITING_ROWS};
use crate::config::{COLOR_CHANNELS, DETAIL_CHANNELS, FEATURE_CHANNELS, Input, ModelConfig};
use crate::side_encoder::LEVEL_WIDTHS;
use crate::unet::{UNET_LEVELS, UnetSpec};

/// As [`peak_bytes`](super::peak_bytes), for a U-Net. Both sides are multiples of 16.
///
/// Each level is a phase. It holds the images, and the maps that it reads, writes, and keeps for later levels.
/// A band of its convolutions and their prepared weights come on top.
pub(super) fn unet_bytes(config: &ModelConfig, height: usize, width: usize) -> u64 {
    let estimate = UnetEstimate {
        spec: config.size.spec(),
        inputs: config.guides.channels(),
        side: (config.variant.spec().side).map(|input| SideChannels::new(input, config.width)),
        plan: BandPlan::new(width),
        height,
        width,
    };
    let images = estimate.map(0, COLOR_CHANNELS + FEATURE_CHANNELS);
    ((images + estimate.largest_phase()) * VALUE) as u64
}

/// Channels of the encoder beside the U-Net.
struct SideChannels {
    /// Those of the first level's convolutions, from the features on.
    first: Vec<usize>,
    levels: [usize; UNET_LEVELS],
}

impl SideChannels {
    fn new(input: Input, width: usize) -> Self {
        let levels = LEVEL_WIDTHS.map(|factor| factor * width);
        let mut first = vec![FEATURE_CHANNELS];
        if input == Input::DetailMap {
            first.extend([width, width, width, DETAIL_CHANNELS]);
        }
        first.extend([levels[0]; 2]);
        SideChannels { first, levels }
    }
}

struct UnetEstimate {
    spec: &'static UnetSpec,
    /// Channels of the network's input.
    inputs: usize,
    side: Option<SideChannels>,
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

    /// The maps of the encoder beside the U-Net, of levels from 0 to `last`.
    fn side_maps(&self, last: usize) -> usize {
        let Some(side) = &self.side else { return 0 };
        (0..=last)
            .map(|level| self.map(level, side.levels[level]))
            .sum()
    }

    /// The phases of that encoder.
    fn side_phases(&self) -> Vec<usize> {
        let Some(side) = &self.side else {
            return Vec::new();
        };
        let phase = |level: usize| {
            let own = side.levels[level];
            let channels = match level {
                0 => side.first.clone(),
                _ => vec![side.levels[level - 1], own, own],
            };
            let above = level
                .checked_sub(1)
                .map_or(0, |above| self.map(level, side.levels[above]));
            let pooled = self.map(level + 1, own);
            self.side_maps(level) + above + pooled + self.working(level, &channels)
        };
        (0..UNET_LEVELS).map(phase).collect()
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
        let mut phases = self.side_phases();
        let side = self.side_maps(UNET_LEVELS - 1);
        for level in 0..UNET_LEVELS {
            let channels = [&[self.input(level)], self.spec.encoder[level]].concat();
            let below = self.map(level + 1, self.input(level + 1));
            phases.push(side + self.skips(level) + below + self.working(level, &channels));
        }
        let [first, second] = self.spec.bottom;
        let channels = [self.input(UNET_LEVELS), first, second];
        let bottom = self.working(UNET_LEVELS, &channels) + self.map(UNET_LEVELS, second);
        phases.push(side + self.skips(UNET_LEVELS) + bottom);
        let mut below = second;
        for (index, [first, second]) in self.spec.decoder.into_iter().enumerate() {
            let level = UNET_LEVELS - 1 - index;
            let mut channels = vec![below + self.input(level), first, second];
            let mut output = second;
            if level == 0 {
                channels.push(COLOR_CHANNELS);
                output = COLOR_CHANNELS;
            }
            let side = self.side_maps(level);
            let maps =
                side + self.skips(level) + self.map(level + 1, below) + self.map(level, output);
            phases.push(maps + self.working(level, &channels));
            below = second;
        }
        phases.into_iter().max().expect("at least nine phases")
    }
}
