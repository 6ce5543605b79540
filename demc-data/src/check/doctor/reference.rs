//! Compares a noisy image with its reference: exposure, view, position, noise.
//!
//! The numbers at the limits are those of the 108 training and test renders at 4 samples per pixel,
//! with references of 64 to 1984.

use super::details::{Details, mean, shifts};
use super::finding::Finding;
use crate::check::noise::log_luminance_above;
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
/// Smallest mean square of the difference of hues that counts.
const MIN_HUE: f64 = 1e-3;
/// Share of that difference to which another order of the channels must reduce it (renders: no order reduces it;
/// exchanged: 0.015).
const OTHER_ORDER: f64 = 0.2;
/// Smallest number and share of samples at the largest value of a clamped image (renders: one).
const MIN_CUT: usize = 50;
const CUT_SHARE: f64 = 2e-4;
/// Largest relative difference of such a sample from the reference where a lamp is seen.
const LAMP: f32 = 0.1;
/// Smallest difference of noisy image and reference that shows encoded values: of the logarithms of blocks'
/// means (renders: 0.009).
const DARKER: f64 = 0.02;
/// Largest share of it that remains after decoding.
const CLOSER: f64 = 0.6;
/// Slope of the reference's details on the difference from the noisy image that shows common noise (renders:
/// 0.004; a mean of both: 1).
const SHARED: f64 = 0.2;
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
    exchanged(frame, reference)
        .or_else(|| another_view(&means))
        .or_else(|| other_exposure(&means))
        .or_else(|| clamped(frame, reference))
        .or_else(|| encoded(frame, reference, &means))
        .or_else(|| {
            let images = [&frame.color[..], reference];
            let [noisy, clean] = images.map(|image| Details::of(image, frame));
            let (noisy, clean) = (noisy?, clean?);
            shifted(&noisy, &clean)
                .or_else(|| mixed(frame, reference))
                .or_else(|| noise(&noisy, &clean).filter(|_| !filtered))
        })
}

/// A reference whose channels are in another order: then its blocks have another hue.
fn exchanged(frame: &Frame, reference: &[f32]) -> Option<Mistake> {
    const ORDERS: [([usize; 3], &str); 6] = [
        ([0, 1, 2], "RGB"),
        ([0, 2, 1], "RBG"),
        ([1, 0, 2], "GRB"),
        ([1, 2, 0], "GBR"),
        ([2, 0, 1], "BRG"),
        ([2, 1, 0], "BGR"),
    ];
    let hues = [&frame.color[..], reference].map(|image| {
        let channels = image.chunks_exact(frame.width * frame.height);
        let dark = DARK * exposure(image);
        let logs: Vec<Vec<f64>> = channels
            .map(|channel| {
                let means = block_means_of(&[channel], &[1.0], frame);
                means.iter().map(|mean| (mean + dark).ln()).collect()
            })
            .collect();
        let grey = |block: usize| (logs[0][block] + logs[1][block] + logs[2][block]) / 3.0;
        logs.iter()
            .map(|log| {
                (0..log.len())
                    .map(|block| log[block] - grey(block))
                    .collect()
            })
            .collect::<Vec<Vec<f64>>>()
    });
    let [noisy, clean] = &hues;
    let difference = |order: [usize; 3]| -> f64 {
        let channels = order.into_iter().enumerate();
        let squares = channels.flat_map(|(c, from)| {
            let pairs = noisy[c].iter().zip(&clean[from]);
            pairs.map(|(a, b)| (a - b).powi(2))
        });
        mean(squares)
    };
    let as_named = difference(ORDERS[0].0);
    let others = ORDERS[1..]
        .iter()
        .map(|(order, name)| (difference(*order), *name));
    let (best, order) = others.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (as_named > MIN_HUE && best < OTHER_ORDER * as_named).then(|| {
        (
            "the reference has its channels in another order",
            "exchange them, or name them so in the layout",
            format!("they fit as {order}"),
        )
    })
}

/// A noisy image that was cut off at a value, which the reference exceeds. Where a lamp is seen, the reference
/// has that value, too.
fn clamped(frame: &Frame, reference: &[f32]) -> Option<Mistake> {
    let largest = |image: &[f32]| image.iter().copied().fold(0.0, f32::max);
    let most = largest(&frame.color);
    let pairs = frame.color.iter().zip(reference);
    let at_most = pairs.filter(|(noisy, _)| **noisy == most);
    let cut = at_most.clone().count();
    let differs = at_most.filter(|(_, clean)| (*clean - most).abs() > LAMP * most);
    let is_cut = cut >= MIN_CUT && cut as f64 > CUT_SHARE * frame.color.len() as f64;
    (is_cut && 2 * differs.count() > cut && largest(reference) > most).then(|| {
        (
            "the noisy image is clamped",
            "switch off the clamping of the renderer: it removes light",
            format!("{cut} samples are {most}, its largest value"),
        )
    })
}

/// Images that are encoded for a display. The mean of encoded noise is darker than the encoded mean.
fn encoded(frame: &Frame, reference: &[f32], means: &[Vec<f64>; 2]) -> Option<Mistake> {
    let as_is = log_ratio(means)?;
    if as_is >= -DARKER {
        return None;
    }
    let linear = log_ratio(&[&frame.color[..], reference].map(|image| {
        let decoded: Vec<f32> = image.iter().copied().map(linear_of).collect();
        block_means(&decoded, frame)
    }))?;
    (linear.abs() < CLOSER * as_is.abs()).then(|| {
        (
            "noise makes the noisy image darker than the reference",
            "are both encoded for a display (sRGB)? Training needs linear radiance",
            format!(
                "by {:.1} %, and by {:.1} % after decoding sRGB",
                100.0 * (1.0 - as_is.exp()),
                100.0 * (1.0 - linear.exp())
            ),
        )
    })
}

/// The median over the brighter blocks of the logarithm of noisy image by reference.
fn log_ratio([noisy, clean]: &[Vec<f64>; 2]) -> Option<f64> {
    let dark = BRIGHT * mean(clean.iter().copied());
    let pairs = noisy.iter().zip(clean).filter(|(_, clean)| **clean > dark);
    let mut ratios: Vec<f64> = pairs.map(|(noisy, clean)| (noisy / clean).ln()).collect();
    ratios.sort_by(f64::total_cmp);
    ratios.get(ratios.len() / 2).copied()
}

/// The inverse of the sRGB curve.
fn linear_of(value: f32) -> f32 {
    if value <= 0.04045 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

/// A reference that contains the noise of the noisy image: the difference of both then correlates with it.
fn mixed(frame: &Frame, reference: &[f32]) -> Option<Mistake> {
    let dark = DARK * exposure(reference);
    let [noisy, clean] =
        [&frame.color[..], reference].map(|image| log_luminance_above(image, dark));
    let difference: Vec<f64> = noisy.iter().zip(&clean).map(|(a, b)| a - b).collect();
    let [noise, clean] = [&difference, &clean].map(|image| Details::without_mean(image, frame));
    let variance = noise.variance();
    let share = noise.covariance(&clean, (0, 0)) / variance;
    (variance > MIN_NOISE && share > SHARED).then(|| {
        (
            "the reference has the noise of the noisy image",
            "was it averaged with the noisy image, or continued from its samples? Render it with another seed",
            format!("{:.0} % of it", 100.0 * share / (1.0 + share)),
        )
    })
}

/// Mean luminance of the image's blocks.
fn block_means(image: &[f32], frame: &Frame) -> Vec<f64> {
    let channels: Vec<&[f32]> = image.chunks_exact(frame.width * frame.height).collect();
    block_means_of(&channels, &LUMINANCE, frame)
}

/// Means over blocks of the weighted sum of some channels.
fn block_means_of(channels: &[&[f32]], weights: &[f32], frame: &Frame) -> Vec<f64> {
    let (columns, rows) = (frame.width / BLOCK, frame.height / BLOCK);
    let mut means = vec![0.0; columns * rows];
    for (channel, weight) in channels.iter().zip(weights) {
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

fn shifted(noisy: &Details, clean: &Details) -> Option<Mistake> {
    let scale = (noisy.variance() * clean.variance()).sqrt();
    if scale == 0.0 {
        return None;
    }
    let found = shifts().map(|shift| (noisy.covariance(clean, shift) / scale, shift));
    let (best, shift) = found.max_by(|a, b| a.0.total_cmp(&b.0))?;
    let unmoved = noisy.covariance(clean, (0, 0)) / scale;
    let error = 1.0 / (noisy.count() as f64).sqrt();
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
