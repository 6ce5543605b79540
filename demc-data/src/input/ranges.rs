//! Ranges of summary values over the training scenes, used to detect images unlike all of them.

use demc_program::parallel::{self, threads};
use serde::{Deserialize, Serialize};

use crate::image::frame::{FEATURES, Frame, TEXTURES};
use crate::input::moments::{ChannelMoments, counted_samples};

/// Rec. 709 luminance of red, green and blue.
pub(crate) const LUMINANCE: [f32; 3] = [0.2126, 0.7152, 0.0722];
/// Exponent of the mean that estimates an image's exposure. Dark pixels count; a firefly hardly
/// does (ours).
const EXPOSURE_GAMMA: f64 = 2.2;
/// Share of the training scenes below and above a range (ours).
const TAIL: f64 = 0.05;

/// The exposure of planar colour `[3, N]`, linear HDR: `mean(luminance^(1/2.2))^2.2`, 0 if it is
/// black. A firefly hardly changes it.
pub fn exposure(color_hdr: &[f32]) -> f64 {
    let pixels = color_hdr.len() / 3;
    let compressed: f64 = (0..pixels)
        .map(|i| {
            let channels = LUMINANCE.iter().enumerate();
            let luminance: f32 = channels.map(|(c, y)| y * color_hdr[c * pixels + i]).sum();
            f64::from(luminance.max(0.0)).powf(1.0 / EXPOSURE_GAMMA)
        })
        .sum();
    (compressed / pixels.max(1) as f64).powf(EXPOSURE_GAMMA)
}

/// Summary values of one image.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameSummary {
    /// [`exposure`] of the noisy colour.
    pub exposure: f64,
    /// Mean of each feature channel; for normals and positions over pixels with a hit.
    pub mean: [f64; FEATURES],
    /// Standard deviation of each feature channel, over the same pixels.
    pub std: [f64; FEATURES],
}

impl FrameSummary {
    /// The summary of a frame.
    pub fn of(frame: &Frame) -> Self {
        let pixels = frame.width * frame.height;
        let planes = frame.features.chunks_exact(pixels.max(1)).enumerate();
        let moments = |(channel, plane): (usize, &[f32])| {
            let samples = counted_samples(channel, plane.to_vec(), frame.mask.as_deref());
            ChannelMoments::of(&samples)
        };
        let mut measured = parallel::map(threads().count, planes.collect(), moments).into_iter();
        let features = std::array::from_fn(|_| measured.next().unwrap_or_default());
        Self::new(&frame.color, &features)
    }

    /// From the noisy colour, planar `[3, N]`, and the moments of the features.
    pub(crate) fn new(color_hdr: &[f32], features: &[ChannelMoments; FEATURES]) -> Self {
        Self {
            exposure: exposure(color_hdr),
            mean: features.map(|moments| moments.mean),
            std: features.map(|moments| moments.std()),
        }
    }
}

/// The range of a value over some scenes, without 5 % of them at either end.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Range {
    /// 5 % of the scenes are below.
    pub low: f32,
    /// 5 % of the scenes are above.
    pub high: f32,
}

impl Range {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let last = values.len().saturating_sub(1) as f64;
        let quantile =
            |share: f64| *values.get((share * last).round() as usize).unwrap_or(&0.0) as f32;
        Self {
            low: quantile(TAIL),
            high: quantile(1.0 - TAIL),
        }
    }

    fn with(self, other: Self) -> Self {
        Self {
            low: self.low.min(other.low),
            high: self.high.max(other.high),
        }
    }
}

/// Ranges of the summary values over the training scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ranges {
    /// Range of [`FrameSummary::exposure`].
    pub exposure: Range,
    /// Range of [`FrameSummary::mean`] per channel.
    pub mean: [Range; FEATURES],
    /// Range of [`FrameSummary::std`] per channel.
    pub std: [Range; FEATURES],
}

impl Ranges {
    /// The ranges of these scenes.
    pub fn of(scenes: &[FrameSummary]) -> Self {
        let range =
            |value: &dyn Fn(&FrameSummary) -> f64| Range::of(scenes.iter().map(value).collect());
        Self {
            exposure: range(&|scene| scene.exposure),
            mean: std::array::from_fn(|channel| range(&|scene| scene.mean[channel])),
            std: std::array::from_fn(|channel| range(&|scene| scene.std[channel])),
        }
    }

    /// The ranges under random axis permutation and mirroring ([`crate::training::augment::Augment::axes`]): each axis
    /// of normals and positions may be any other, in either direction.
    pub fn in_any_axes(&self) -> Self {
        let (mut mean, mut std) = (self.mean, self.std);
        let axes = mean[..TEXTURES].chunks_mut(3);
        for (mean, std) in axes.zip(std[..TEXTURES].chunks_mut(3)) {
            let farthest = mean
                .iter()
                .map(|range| range.high.max(-range.low))
                .fold(0.0, f32::max);
            mean.fill(Range {
                low: -farthest,
                high: farthest,
            });
            std.fill(std[0].with(std[1]).with(std[2]));
        }
        Self {
            exposure: self.exposure,
            mean,
            std,
        }
    }

    /// The ranges that contain these and those of earlier training with the same weights.
    pub fn with(&self, before: &Ranges) -> Self {
        let both = |a: &[Range; FEATURES], b: &[Range; FEATURES]| {
            std::array::from_fn(|channel| a[channel].with(b[channel]))
        };
        Self {
            exposure: self.exposure.with(before.exposure),
            mean: both(&self.mean, &before.mean),
            std: both(&self.std, &before.std),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(color: f32, feature: f32) -> Frame {
        Frame::new(
            "flat",
            4,
            2,
            vec![color; 24],
            (0..12 * 8).map(|i| feature + (i % 2) as f32).collect(),
        )
    }

    #[test]
    fn a_flat_image_has_its_own_exposure_and_moments() {
        let summary = FrameSummary::of(&frame(0.25, 3.0));
        assert!((summary.exposure - 0.25).abs() < 1e-6);
        assert_eq!((summary.mean[3], summary.std[3]), (3.5, 0.5));
    }

    #[test]
    fn misses_do_not_count_for_geometry() {
        let mut frame = frame(0.25, 3.0);
        frame.mask = Some([1.0, 0.0].repeat(4));
        let summary = FrameSummary::of(&frame);
        assert_eq!((summary.mean[5], summary.std[5]), (3.0, 0.0));
        assert_eq!((summary.mean[6], summary.std[6]), (1.0, 0.0), "albedo");
    }

    #[test]
    fn combined_ranges_contain_both() {
        let ranges = |color, feature| Ranges::of(&[FrameSummary::of(&frame(color, feature))]);
        let both = ranges(0.25, 3.0).with(&ranges(1.0, 1.0));
        let ends = |range: Range| [range.low, range.high];
        assert!((ends(both.exposure)[0] - 0.25).abs() < 1e-6);
        assert!((ends(both.exposure)[1] - 1.0).abs() < 1e-6);
        assert_eq!(ends(both.mean[3]), [1.5, 3.5]);
        assert_eq!(ends(both.std[3]), [0.5, 0.5]);
    }

    #[test]
    fn in_any_axes_each_of_them_may_be_any_other() {
        let mut ranges = Ranges::of(&[FrameSummary::of(&frame(0.25, 3.0))]);
        let before = ranges.clone();
        let range = |low, high| Range { low, high };
        ranges.mean[3..6].copy_from_slice(&[range(-7.0, 1.0), range(2.0, 3.0), range(0.0, 5.0)]);
        ranges.std[3..6].copy_from_slice(&[range(1.0, 2.0), range(0.5, 0.7), range(3.0, 4.0)]);
        let any = ranges.in_any_axes();
        assert_eq!(any.mean[3..6], [range(-7.0, 7.0); 3]);
        assert_eq!(any.std[3..6], [range(0.5, 4.0); 3]);
        assert_eq!(any.mean[0], range(-3.5, 3.5));
        assert_eq!(any.mean[6..], before.mean[6..]);
        assert_eq!(any.std[6..], before.std[6..]);
        assert_eq!(any.exposure, before.exposure);
    }

    #[test]
    fn a_range_excludes_a_twentieth_at_either_end() {
        let range = Range::of((0..=100).rev().map(f64::from).collect());
        let (low, high) = (5.0, 95.0);
        assert_eq!(range, Range { low, high });
        let only = Range::of(vec![2.0]);
        assert_eq!((only.low, only.high), (2.0, 2.0));
    }
}
