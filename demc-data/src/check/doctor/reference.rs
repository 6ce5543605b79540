//! Compares a noisy image with its reference: exposure, view, position, noise.
//!
//! The numbers at the limits are those of the 108 training and test renders at 4 samples per pixel,
//! with references of 64 to 1984.

use super::finding::Finding;
use crate::check::noise::log_luminance;
use crate::image::frame::Frame;
use crate::input::ranges::{LUMINANCE, exposure};

/// Width and height of the blocks whose means have little noise.
const BLOCK: usize = 16;
/// Smallest number of such blocks.
const MIN_BLOCKS: usize = 16;
/// Smallest correlation of the logarithms of the blocks' means (renders: 0.979; other views and
/// scenes: at most 0.876).
const SAME_VIEW: f64 = 0.92;
/// Largest difference of the exposures in stops (renders: 0.05).
const MAX_STOPS: f64 = 0.3;
/// Farthest shift that is tried, in pixels.
const FARTHEST: usize = 2;
/// Standard errors by which the correlation of a shifted reference must be larger.
const MIN_ERRORS: f64 = 4.0;
/// Largest noise variance of the reference, as a share of the noisy image's (renders: 0.19).
const MAX_NOISE: f64 = 0.5;
/// Smallest noise variance that counts, in log luminance.
const MIN_NOISE: f64 = 1e-4;
/// Largest exposure of a black reference, as a share of the noisy image's.
const BLACK: f64 = 1e-3;
/// Luminance that is added before a logarithm, in exposures.
const DARK: f64 = 0.05;
/// Smallest mean of a block that tells the exposure, in exposures of the reference.
const BRIGHT: f64 = 0.1;

/// The first mistake of a scene's reference; later checks assume the earlier ones. If the noisy image
/// is `filtered`, its details are not those of the reference, and the noise is not compared.
pub(super) fn findings(name: &str, frame: &Frame, filtered: bool) -> Vec<Finding> {
    let reference = frame.reference.as_deref();
    let found = reference.and_then(|reference| mistake(frame, reference, filtered));
    let finding = found.map(|(problem, cause, detail)| Finding::new(problem, cause, name, detail));
    finding.into_iter().collect()
}

type Mistake = (&'static str, &'static str, String);

fn mistake(frame: &Frame, reference: &[f32], filtered: bool) -> Option<Mistake> {
    let light = exposure(&frame.color);
    if light == 0.0 {
        let cause = "is another channel called so, or is a light missing?";
        return Some(("the noisy image is black", cause, String::new()));
    }
    if exposure(reference) < BLACK * light {
        let cause = "did the reference's render fail?";
        return Some(("the reference is black", cause, String::new()));
    }
    if frame.color == reference {
        let cause = "the noisy image was appended twice; append the render with many samples";
        let problem = "the reference is the noisy image itself";
        return Some((problem, cause, String::new()));
    }
    let means = [&frame.color[..], reference].map(|image| block_means(image, frame));
    if means[0].len() < MIN_BLOCKS {
        return None;
    }
    another_view(&means)
        .or_else(|| other_exposure(&means))
        .or_else(|| {
            let images = [&frame.color[..], reference];
            let [noisy, clean] = images.map(|image| Details::of(image, frame));
            let (noisy, clean) = (noisy?, clean?);
            shifted(&noisy, &clean).or_else(|| noise(&noisy, &clean).filter(|_| !filtered))
        })
}

/// Mean luminance of the image's blocks.
fn block_means(image: &[f32], frame: &Frame) -> Vec<f64> {
    let pixels = frame.width * frame.height;
    let (columns, rows) = (frame.width / BLOCK, frame.height / BLOCK);
    let mut means = vec![0.0; columns * rows];
    for (channel, weight) in image.chunks_exact(pixels).zip(LUMINANCE) {
        for y in 0..rows * BLOCK {
            for x in 0..columns * BLOCK {
                means[y / BLOCK * columns + x / BLOCK] +=
                    f64::from(weight * channel[y * frame.width + x]);
            }
        }
    }
    means.iter_mut().for_each(|m| *m /= (BLOCK * BLOCK) as f64);
    means
}

/// The exposure of block means.
fn block_exposure(means: &[f64]) -> f64 {
    let compressed: f64 = means.iter().map(|mean| mean.powf(1.0 / 2.2)).sum();
    (compressed / means.len() as f64).powf(2.2)
}

fn another_view(means: &[Vec<f64>; 2]) -> Option<Mistake> {
    let logs = means.each_ref().map(|means| -> Vec<f64> {
        let dark = DARK * block_exposure(means);
        means.iter().map(|mean| (mean + dark).ln()).collect()
    });
    let correlation = correlation(&logs[0], &logs[1])?;
    (correlation < SAME_VIEW).then(|| {
        (
            "the reference shows another image",
            "another view, another scene, or other materials and lights",
            format!("blurred images correlate by {correlation:.2}"),
        )
    })
}

fn other_exposure([noisy, clean]: &[Vec<f64>; 2]) -> Option<Mistake> {
    let dark = BRIGHT * block_exposure(clean);
    let pairs = noisy.iter().zip(clean).filter(|(_, clean)| **clean > dark);
    let mut ratios: Vec<f64> = pairs.map(|(noisy, clean)| clean / noisy).collect();
    ratios.sort_by(f64::total_cmp);
    let stops = ratios.get(ratios.len() / 2)?.log2();
    (stops.abs() > MAX_STOPS).then(|| {
        (
            "the reference has another exposure than the noisy image",
            "render both with one exposure, or divide by it",
            if stops > 0.0 {
                format!("{stops:.1} stops brighter")
            } else {
                format!("{:.1} stops darker", -stops)
            },
        )
    })
}

/// Log luminance without the mean of 5x5 pixels.
struct Details {
    width: usize,
    height: usize,
    values: Vec<f64>,
}

impl Details {
    fn of(image: &[f32], frame: &Frame) -> Option<Self> {
        let Frame { width, height, .. } = *frame;
        let log = log_luminance(image)?;
        let mut values = vec![0.0; log.len()];
        for y in FARTHEST..height.saturating_sub(FARTHEST) {
            for x in FARTHEST..width.saturating_sub(FARTHEST) {
                let rows = (y - FARTHEST..=y + FARTHEST).map(|row| row * width + x - FARTHEST);
                let sum: f64 = rows
                    .flat_map(|start| &log[start..=start + 2 * FARTHEST])
                    .sum();
                values[y * width + x] = log[y * width + x] - sum / 25.0;
            }
        }
        Some(Self {
            width,
            height,
            values,
        })
    }

    /// The details at a distance from the border, moved by `shift`.
    fn moved(&self, shift: (isize, isize)) -> impl Iterator<Item = f64> {
        let border = 2 * FARTHEST;
        let columns = border..self.width - border;
        let start = columns.start.wrapping_add_signed(shift.0);
        let rows = (border..self.height - border).map(move |y| {
            let y = y.wrapping_add_signed(shift.1);
            &self.values[y * self.width + start..][..columns.len()]
        });
        rows.flatten().copied()
    }

    fn variance(&self) -> f64 {
        mean(self.moved((0, 0)).map(|x| x * x))
    }

    /// Mean product with another image's details, of which the pixel at `shift` is taken.
    fn covariance(&self, other: &Self, shift: (isize, isize)) -> f64 {
        mean(
            self.moved((0, 0))
                .zip(other.moved(shift))
                .map(|(a, b)| a * b),
        )
    }
}

fn shifted(noisy: &Details, clean: &Details) -> Option<Mistake> {
    let scale = (noisy.variance() * clean.variance()).sqrt();
    if scale == 0.0 {
        return None;
    }
    let reach = FARTHEST as isize;
    let shifts = (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| (x, y)));
    let found = shifts.map(|shift| (noisy.covariance(clean, shift) / scale, shift));
    let (best, shift) = found.max_by(|a, b| a.0.total_cmp(&b.0))?;
    let unmoved = noisy.covariance(clean, (0, 0)) / scale;
    let error = 1.0 / (noisy.moved((0, 0)).count() as f64).sqrt();
    let (x, y) = shift;
    (best - unmoved > MIN_ERRORS * error).then(|| {
        (
            "the reference is shifted against the noisy image",
            "another crop, film offset, or data window",
            format!("by {x:+} {y:+} pixels"),
        )
    })
}

/// Independent noise: the variance of the details that the two images do not share.
fn noise(noisy: &Details, clean: &Details) -> Option<Mistake> {
    let shared = noisy.covariance(clean, (0, 0));
    let (noisy, clean) = (noisy.variance() - shared, clean.variance() - shared);
    (clean > MIN_NOISE && clean > MAX_NOISE * noisy.max(0.0)).then(|| {
        (
            "the reference is about as noisy as the noisy image",
            "too few samples per pixel, or noisy image and reference swapped",
            if noisy > 0.0 {
                format!("{:.0} % of its noise variance", 100.0 * clean / noisy)
            } else {
                "the noisy image has no noise of its own".to_owned()
            },
        )
    })
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0_usize), |(sum, n), x| (sum + x, n + 1));
    sum / count.max(1) as f64
}

/// Pearson's correlation; `None` if a list is constant.
pub(super) fn correlation(a: &[f64], b: &[f64]) -> Option<f64> {
    let [mean_a, mean_b] = [a, b].map(|list| mean(list.iter().copied()));
    let product = |x: &[f64], mean_x: f64, y: &[f64], mean_y: f64| -> f64 {
        let pairs = x.iter().zip(y);
        pairs.map(|(x, y)| (x - mean_x) * (y - mean_y)).sum()
    };
    let scale = (product(a, mean_a, a, mean_a) * product(b, mean_b, b, mean_b)).sqrt();
    (scale > 0.0).then(|| product(a, mean_a, b, mean_b) / scale)
}
