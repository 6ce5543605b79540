//! NFOR: Bitterli et al. 2016, "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo
//! Renderings". Needs no training, but half buffers and variances of colour and features. Sections are
//! those of that paper.
//!
//! 1. Features are filtered by NL-means, each half with weights of the other half (Sec. 5.1).
//! 2. A regression fits each half of the colour, with weights and features of the other
//!    half, for two bandwidths (Sec. 5.2).
//! 3. Errors of both are estimated from the halves and filtered. The bandwidth of the smaller error is
//!    chosen for each pixel, and the choice filtered (Sec. 5.3).
//! 4. Features and the mean of both halves are filtered once more (Sec. 5.4).

mod nl_means;
mod planes;
mod regression;
mod solve;
#[cfg(test)]
mod tests;
mod weights;

use demc_data::ChannelLayout;
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::{PassPlanes, decode_passes};
use nl_means::nl_means;
use planes::Planes;
use regression::Regression;
use weights::Guide;

use crate::memory;

/// Radius of the patches of features and colour (7x7 pixels).
const PATCH: usize = 3;
/// Radius of the patches for errors and choices (3x3 pixels).
const ERROR_PATCH: usize = 1;
/// Radius of the windows of features (11x11 pixels), and when filtered for the second time (5x5).
const FEATURE_WINDOWS: [usize; 2] = [5, 2];
/// Radius of the windows of errors and choices (19x19 pixels).
const ERROR_WINDOW: usize = 9;
/// Bandwidth of features.
const FEATURE_BANDWIDTH: f32 = 0.5;
/// Bandwidths of the colour.
const BANDWIDTHS: [f32; 2] = [0.5, 1.0];
/// Bandwidth of errors, choices, and the second pass.
const LAST_BANDWIDTH: f32 = 1.0;

/// Depths from here on are no distances (ours). Mitsuba has 0, Cycles 1e10, others FLT_MAX.
const FAR: f32 = 1e9;
/// Larger samples are refused (ours): their squares would be infinite.
const LARGEST: f32 = 1e15;

/// Memory for each pixel in bytes, beside the buffers (ours, measured).
const BYTES_PER_PIXEL: u64 = 320;

/// A rendered buffer, `[C, H, W]` each.
#[derive(Debug, Clone, PartialEq)]
pub struct Buffer {
    /// The means of two halves of the samples.
    pub halves: [Vec<f32>; 2],
    /// The variance of the mean of all samples.
    pub variance: Vec<f32>,
}

/// The buffers of an image. Samples are finite.
#[derive(Debug, Clone, PartialEq)]
pub struct Buffers {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Linear radiance, 3 channels.
    pub color: Buffer,
    /// 3 channels.
    pub normal: Buffer,
    /// At the first hit, 3 channels.
    pub albedo: Buffer,
    /// Distance from the camera, 1 channel.
    pub depth: Buffer,
}

/// Why an image cannot be filtered.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum NforError {
    /// A buffer of another size.
    #[error("{buffer} has {found} samples instead of {expected}")]
    Size {
        buffer: &'static str,
        found: usize,
        expected: usize,
    },
    /// A sample whose square is out of range.
    #[error("{buffer} has a sample of {value:e}; NFOR takes up to {LARGEST:e}")]
    Large { buffer: &'static str, value: f32 },
    /// Not enough memory.
    #[error("NFOR of {width}x{height} pixels needs {needed} MiB; {available} MiB are available")]
    Memory {
        width: usize,
        height: usize,
        needed: u64,
        available: u64,
    },
}

/// The buffers of a layout that become those of [`Buffers`], in their order.
const CONTENTS: [&str; 4] = ["color", "normal", "texture1", "depth"];

impl Buffer {
    /// Sets depths from [`FAR`] on to 0: with them, renderers say that a camera ray hits nothing.
    fn forget_misses(&mut self) {
        let Self {
            halves: [first, second],
            variance,
        } = self;
        for ((first, second), variance) in first.iter_mut().zip(second).zip(variance) {
            if first.max(*second) >= FAR {
                (*first, *second, *variance) = (0.0, 0.0, 0.0);
            }
        }
    }
}

impl Buffers {
    /// Reads the buffers of a file, whose layout names them (`[passes]`).
    ///
    /// # Errors
    /// As [`decode_passes`].
    pub fn read(file: &mut ExrFile, layout: &ChannelLayout) -> Result<Self, demc_data::Error> {
        let kinds = ["half buffer 1", "half buffer 2", "variance"];
        let contents = CONTENTS.map(|buffer| kinds.map(|kind| format!("{kind} of {buffer}")));
        let contents: Vec<&str> = contents.as_flattened().iter().map(String::as_str).collect();
        let PassPlanes {
            width,
            height,
            buffers,
        } = decode_passes(file, layout, &contents)?;
        let mut buffers = buffers.into_iter();
        let mut next = || buffers.next().expect("one for each content");
        let [color, normal, albedo, mut depth] = CONTENTS.map(|_| Buffer {
            halves: [next(), next()],
            variance: next(),
        });
        depth.forget_misses();
        Ok(Self {
            width,
            height,
            color,
            normal,
            albedo,
            depth,
        })
    }

    /// The denoised colour, `[3, H, W]`, which is not negative. Any number of threads gives the same
    /// bits.
    ///
    /// # Errors
    /// A buffer of another size; a sample above 1e15; too little memory.
    pub fn denoise(&self) -> Result<Vec<f32>, NforError> {
        self.check()?;
        let color = self.halves(&self.color);
        let features = self.filtered_features();
        let [first, second] = [0, 1].map(|half| {
            let guide = &color.halves[1 - half];
            let regression = Regression {
                color: &color.halves[half],
                features: &features[1 - half],
                guide: guide_of(guide, &color.half_variance),
            };
            regression.fit(BANDWIDTHS)
        });
        let halves = color.choose(&first, &second);
        drop((first, second, color));
        let means = features_again(features);
        let (color, variance) = mean_and_variance(&halves);
        let regression = Regression {
            color: &color,
            features: &means,
            guide: guide_of(&color, &variance),
        };
        let [fitted] = regression.fit([LAST_BANDWIDTH]);
        let positive = fitted.samples.into_iter().map(|sample| sample.max(0.0));
        Ok(positive.collect())
    }

    fn check(&self) -> Result<(), NforError> {
        let pixels = self.width * self.height;
        let named = [
            ("color", &self.color, 3),
            ("normal", &self.normal, 3),
            ("albedo", &self.albedo, 3),
            ("depth", &self.depth, 1),
        ];
        for (buffer, content, channels) in named {
            for samples in content.halves.iter().chain([&content.variance]) {
                let (found, expected) = (samples.len(), channels * pixels);
                if found != expected {
                    return Err(NforError::Size {
                        buffer,
                        found,
                        expected,
                    });
                }
                let largest = samples
                    .iter()
                    .copied()
                    .find(|sample| sample.abs() > LARGEST);
                if let Some(value) = largest {
                    return Err(NforError::Large { buffer, value });
                }
            }
        }
        let needed = BYTES_PER_PIXEL * pixels as u64;
        match memory::available() {
            Some(available) if available < needed => Err(NforError::Memory {
                width: self.width,
                height: self.height,
                needed: needed >> 20,
                available: available >> 20,
            }),
            _ => Ok(()),
        }
    }

    fn halves(&self, buffer: &Buffer) -> Halves {
        let planes = |samples: &Vec<f32>| Planes {
            width: self.width,
            height: self.height,
            samples: samples.clone(),
        };
        let variance = planes(&buffer.variance);
        Halves {
            half_variance: Planes::of(&variance, &variance, |a, _| 2.0 * a.max(0.0)),
            halves: buffer.halves.each_ref().map(planes),
        }
    }

    /// Both halves of all features, each filtered with the weights of the other (Sec. 5.1).
    fn filtered_features(&self) -> [Planes; 2] {
        let buffers = [&self.normal, &self.albedo, &self.depth].map(|buffer| self.halves(buffer));
        [0, 1].map(|half| {
            let filtered = buffers.each_ref().map(|buffer| {
                let guide = guide_of(&buffer.halves[1 - half], &buffer.half_variance);
                let image = &buffer.halves[half];
                nl_means(image, &guide, FEATURE_WINDOWS[0], FEATURE_BANDWIDTH)
            });
            Planes::stacked(&filtered)
        })
    }
}

fn guide_of<'a>(image: &'a Planes, variance: &'a Planes) -> Guide<'a> {
    Guide {
        image,
        variance,
        patch: PATCH,
    }
}

/// A buffer's halves.
struct Halves {
    halves: [Planes; 2],
    /// Variance of each half: twice that of their mean.
    half_variance: Planes,
}

impl Halves {
    /// Both halves with the bandwidth of the smaller error at each pixel (Sec. 5.3). `first` and `second` are
    /// the fits of the halves by bandwidth.
    fn choose(&self, first: &[Planes; 2], second: &[Planes; 2]) -> [Planes; 2] {
        let [noisy_first, noisy_second] = &self.halves;
        let mean = Planes::of(noisy_first, noisy_second, |a, b| 0.5 * (a + b));
        let variance = Planes::of(&self.half_variance, &self.half_variance, |a, _| 0.5 * a);
        let guide = Guide {
            image: &mean,
            variance: &variance,
            patch: ERROR_PATCH,
        };
        let filter = |image: &Planes| nl_means(image, &guide, ERROR_WINDOW, LAST_BANDWIDTH);
        let errors = [0, 1].map(|k| self.errors(&first[k], &second[k]));
        let errors = filter(&Planes::stacked(&errors));
        let (narrow, wide) = errors.samples.split_at(errors.pixels());
        let choice = Planes {
            samples: narrow
                .iter()
                .zip(wide)
                .map(|(narrow, wide)| if narrow < wide { 0.0 } else { 1.0 })
                .collect(),
            ..mean
        };
        let choice = filter(&choice);
        [first, second].map(|[narrow, wide]| {
            let mut chosen = Planes::of(narrow, wide, |narrow, wide| wide - narrow);
            let pixels = chosen.pixels();
            for (i, chosen) in chosen.samples.iter_mut().enumerate() {
                *chosen = narrow.samples[i] + choice.samples[i % pixels] * *chosen;
            }
            chosen
        })
    }

    /// The estimated squared error of the mean of two fitted halves, averaged over channels, `[1, H, W]`.
    fn errors(&self, first: &Planes, second: &Planes) -> Planes {
        let pixels = first.pixels();
        let channels = first.channels();
        let error = |i: usize| {
            let squared = |a: f32, b: f32| (a - b) * (a - b);
            let (first, second) = (first.samples[i], second.samples[i]);
            let from_second = squared(self.halves[1].samples[i], first);
            let from_first = squared(self.halves[0].samples[i], second);
            let noise = self.half_variance.samples[i];
            0.5 * (from_first + from_second) - noise - 0.25 * squared(first, second)
        };
        let mean = |pixel: usize| {
            let sum: f32 = (0..channels)
                .map(|channel| error(channel * pixels + pixel))
                .sum();
            sum / channels as f32
        };
        Planes {
            samples: (0..pixels).map(mean).collect(),
            ..*first
        }
    }
}

/// The mean of two halves, and its variance.
fn mean_and_variance([first, second]: &[Planes; 2]) -> (Planes, Planes) {
    let mean = Planes::of(first, second, |a, b| 0.5 * (a + b));
    let variance = Planes::of(first, second, |a, b| 0.25 * (a - b) * (a - b));
    (mean, variance)
}

/// The mean of both halves of the features, filtered for the second time (Sec. 5.4).
fn features_again(halves: [Planes; 2]) -> Planes {
    let (mean, variance) = mean_and_variance(&halves);
    let buffers = [0..3, 3..6, 6..7].map(|channels| {
        let [mean, variance] = [&mean, &variance].map(|image| image.part(channels.clone()));
        let guide = guide_of(&mean, &variance);
        nl_means(&mean, &guide, FEATURE_WINDOWS[1], FEATURE_BANDWIDTH)
    });
    Planes::stacked(&buffers)
}
