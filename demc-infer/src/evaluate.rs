//! Scores of a network: RelMSE and SSIM of the noisy, an all-black and the denoised image against the reference.
//!
//! The black image is there because being better than the noisy one proves nothing: at few samples a pixel, black
//! itself is (about 2.5 to 3 in RelMSE). The reference has an error of its own, the residual; a score near it means
//! nothing either.

use std::fmt;

use demc_data::Frame;
use demc_model::metrics;
use serde::{Deserialize, Serialize};

use crate::Bundle;
use crate::denoise::DenoiseError;

/// How near an image is to its reference.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Eq. 5: summed over rgb, averaged over pixels, epsilon 0.001, linear HDR. Smaller is better.
    pub relmse: f64,
    /// Wang et al. 2004 on `clip(x, 0, 1)^(1 / 2.2)`, at most 1; `None` for an image below its 11x11 window.
    pub ssim: Option<f64>,
}

impl Score {
    /// The score of `candidate` against `reference`, both planar `[3, height, width]` in linear HDR.
    pub fn of(candidate: &[f32], reference: &[f32], height: usize, width: usize) -> Self {
        Self {
            relmse: metrics::rel_mse_image(candidate, reference),
            ssim: metrics::ssim(candidate, reference, height, width),
        }
    }

    /// The mean of each number; of SSIM over the images that have one.
    fn mean<'a>(scores: impl Iterator<Item = &'a Score> + Clone) -> Self {
        let average = |values: &mut dyn Iterator<Item = f64>| {
            let (count, sum) = values.fold((0.0, 0.0), |(n, sum), value| (n + 1.0, sum + value));
            (count > 0.0).then(|| sum / count)
        };
        Self {
            relmse: average(&mut scores.clone().map(|s| s.relmse)).unwrap_or(f64::NAN),
            ssim: average(&mut scores.filter_map(|s| s.ssim)),
        }
    }
}

/// The scores of one image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ImageScore {
    /// The image.
    pub name: String,
    /// The input.
    pub noisy: Score,
    /// An image of zeros.
    pub black: Score,
    /// The network's output.
    pub denoised: Score,
    /// RelMSE of the reference against a perfect one, where the data set knows it.
    pub reference_residual: Option<f64>,
}

impl ImageScore {
    /// The scores of `frame` and its denoised image (planar `[3, H, W]`, linear HDR).
    ///
    /// # Errors
    /// [`DenoiseError::NoReference`] for a frame without reference.
    pub fn new(
        frame: &Frame,
        denoised: &[f32],
        reference_residual: Option<f64>,
    ) -> Result<Self, DenoiseError> {
        let Frame { width, height, .. } = *frame;
        let reference = frame.reference.as_deref();
        let reference = reference.ok_or_else(|| DenoiseError::NoReference {
            name: frame.name.clone(),
        })?;
        let score = |candidate: &[f32]| Score::of(candidate, reference, height, width);
        Ok(Self {
            name: frame.name.clone(),
            noisy: score(&frame.color),
            black: score(&vec![0.0; reference.len()]),
            denoised: score(denoised),
            reference_residual,
        })
    }
}

/// Denoises `frame` and scores it: one image in memory at a time.
///
/// # Errors
/// As [`Bundle::denoise`], and for a frame without reference.
pub fn score(
    bundle: &Bundle,
    frame: &Frame,
    reference_residual: Option<f64>,
) -> Result<ImageScore, DenoiseError> {
    ImageScore::new(frame, &bundle.denoise(frame)?, reference_residual)
}

/// The means over a report's images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MeanScore {
    /// Of the inputs.
    pub noisy: Score,
    /// Of images of zeros.
    pub black: Score,
    /// Of the network's outputs.
    pub denoised: Score,
}

/// The scores of several images and their mean. [`Display`](fmt::Display) is a Markdown table; the JSON of
/// `serde` is `{"images": [...], "mean": {...}}`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// One score an image, in the order given.
    pub images: Vec<ImageScore>,
    /// Their mean; every image counts the same.
    pub mean: MeanScore,
}

impl Report {
    /// The report on these images.
    pub fn new(images: Vec<ImageScore>) -> Self {
        let mean = |of: fn(&ImageScore) -> &Score| Score::mean(images.iter().map(of));
        let mean = MeanScore {
            noisy: mean(|image| &image.noisy),
            black: mean(|image| &image.black),
            denoised: mean(|image| &image.denoised),
        };
        Self { images, mean }
    }
}

/// Heads of the table's columns. The group stands before each metric, so that a row can be read alone.
const COLUMNS: [&str; 8] = [
    "image",
    "RelMSE noisy",
    "black",
    "denoised",
    "reference residual",
    "SSIM noisy",
    "black",
    "denoised",
];

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let MeanScore {
            noisy,
            black,
            denoised,
        } = &self.mean;
        let rows: Vec<_> = self
            .images
            .iter()
            .map(|i| {
                row(
                    &i.name,
                    [&i.noisy, &i.black, &i.denoised],
                    i.reference_residual,
                )
            })
            .chain([row("mean", [noisy, black, denoised], None)])
            .collect();
        let width = |column: usize| {
            let cells = rows.iter().map(|row| row[column].chars().count());
            cells.max().unwrap_or(0).max(COLUMNS[column].len())
        };
        let widths: [usize; 8] = std::array::from_fn(width);
        let rule: [String; 8] = std::array::from_fn(|i| match i {
            0 => "-".repeat(widths[0]),
            i => "-".repeat(widths[i] - 1) + ":",
        });
        let head = COLUMNS.map(String::from);
        for cells in [&head, &rule].into_iter().chain(&rows) {
            let [first, numbers @ ..] = cells;
            write!(f, "| {first:<width$} |", width = widths[0])?;
            for (number, width) in numbers.iter().zip(&widths[1..]) {
                write!(f, " {number:>width$} |")?;
            }
            writeln!(f)?;
        }
        writeln!(f)?;
        write!(
            f,
            "RelMSE: Eq. 5, summed over rgb, linear HDR, smaller is better. \
             SSIM: Wang et al. 2004 on clip(x, 0, 1)^(1/2.2), larger is better."
        )
    }
}

fn row(name: &str, scores: [&Score; 3], residual: Option<f64>) -> [String; 8] {
    let number = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.4}"));
    let [a, b, c] = scores.map(|score| number(Some(score.relmse)));
    let [d, e, f] = scores.map(|score| number(score.ssim));
    [name.into(), a, b, c, number(residual), d, e, f]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(name: &str, relmse: f64, ssim: Option<f64>) -> ImageScore {
        let score = Score { relmse, ssim };
        ImageScore {
            name: name.into(),
            noisy: score,
            black: score,
            denoised: score,
            reference_residual: Some(0.1),
        }
    }

    #[test]
    fn the_mean_counts_every_image_once_and_skips_a_missing_ssim() {
        let report = Report::new(vec![image("a", 1.0, Some(0.5)), image("b", 3.0, None)]);
        let expected = Score {
            relmse: 2.0,
            ssim: Some(0.5),
        };
        assert_eq!(report.mean.denoised, expected);
        assert_eq!(report.mean.noisy, expected);
    }

    #[test]
    fn the_rows_of_the_table_have_one_width() {
        let report = Report::new(vec![
            image("a", 1.0, None),
            image("a-long-name", 1234.5, Some(0.5)),
        ]);
        let table = report.to_string();
        let lines: Vec<_> = table
            .lines()
            .take_while(|line| line.starts_with('|'))
            .collect();
        assert_eq!(lines.len(), 5);
        assert!(
            lines.iter().all(|line| line.len() == lines[0].len()),
            "{table}"
        );
        assert!(lines[4].starts_with("| mean "), "{table}");
    }

    #[test]
    fn a_frame_without_reference_is_named() {
        let frame = crate::bundle::testing::frame(4, 4);
        let error = ImageScore::new(&frame, &frame.color, None).expect_err("no reference");
        assert_eq!(error.to_string(), "pattern: no reference in the file");
    }
}
