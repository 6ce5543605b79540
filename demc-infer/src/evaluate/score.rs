//! Scores of images and of a data set.

use std::collections::BTreeMap;

use demc_data::Frame;
use demc_model::metrics::{self, Image, METRICS};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::Bundle;
use crate::denoise::DenoiseError;

/// Distance of an image from its reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// RelMSE (Eq. 5): summed over rgb, averaged over pixels, epsilon 0.001, linear HDR. Smaller is
    /// better.
    pub relmse: f64,
    /// SSIM (Wang et al. 2004) on `clip(x, 0, 1)^(1 / 2.2)`, at most 1; `None` for an image smaller
    /// than the 11x11 window.
    pub ssim: Option<f64>,
    /// The other metrics of [`METRICS`] by name, if computed; `None` for a metric without a value.
    #[serde(flatten)]
    pub others: BTreeMap<String, Option<f64>>,
}

impl Score {
    /// RelMSE and SSIM of `candidate` against `reference`.
    pub fn headline(candidate: &Image, reference: &Image) -> Self {
        Self {
            relmse: metrics::rel_mse(candidate, reference),
            ssim: metrics::ssim(candidate, reference),
            others: BTreeMap::new(),
        }
    }

    /// All metrics of `candidate` against `reference`.
    pub fn full(candidate: &Image, reference: &Image) -> Self {
        candidate.prepare();
        reference.prepare();
        let values: Vec<Option<f64>> = METRICS
            .par_iter()
            .map(|metric| (metric.measure)(candidate, reference))
            .collect();
        let mut others: BTreeMap<String, Option<f64>> = METRICS
            .iter()
            .zip(values)
            .map(|(metric, value)| (metric.name.to_owned(), value))
            .collect();
        Self {
            relmse: others.remove("relmse").flatten().expect("always a value"),
            ssim: others.remove("ssim").flatten(),
            others,
        }
    }

    /// The value of the metric `name`; `None` if it was not computed or has no value.
    pub fn get(&self, name: &str) -> Option<f64> {
        match name {
            "relmse" => Some(self.relmse),
            "ssim" => self.ssim,
            name => self.others.get(name).copied().flatten(),
        }
    }

    /// The mean of each metric over the images with a value.
    fn mean(scores: &[&Score]) -> Self {
        let average = |value: &dyn Fn(&Score) -> Option<f64>| {
            let (count, sum) = scores
                .iter()
                .filter_map(|score| value(score))
                .fold((0.0, 0.0), |(n, sum), value| (n + 1.0, sum + value));
            (count > 0.0).then(|| sum / count)
        };
        let names = scores.first().map(|score| score.others.keys());
        let others = names.into_iter().flatten().map(|name| {
            let mean = average(&|score| score.get(name));
            (name.clone(), mean)
        });
        Self {
            relmse: average(&|score| Some(score.relmse)).unwrap_or(f64::NAN),
            ssim: average(&|score| score.ssim),
            others: others.collect(),
        }
    }
}

pub(super) fn is_headline(name: &str) -> bool {
    matches!(name, "relmse" | "ssim")
}

/// The scores of one image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ImageScore {
    /// The image.
    pub name: String,
    /// Its base scene in the data set; `None` for an image of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base: Option<String>,
    /// Score of the input.
    pub noisy: Score,
    /// Score of an all-zero image.
    pub black: Score,
    /// Score of the network's output.
    pub denoised: Score,
    /// Scores of other programs' images, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub baselines: BTreeMap<String, Score>,
    /// Expected RelMSE of the reference against a noise-free image, if the data set has it.
    pub reference_residual: Option<f64>,
}

impl ImageScore {
    /// RelMSE and SSIM of `frame` and its denoised image.
    ///
    /// # Shapes
    /// `denoised` is planar `[3, H, W]` in linear HDR.
    ///
    /// # Errors
    /// [`DenoiseError::NoReference`] for a frame without reference, [`DenoiseError::Image`] for NaN
    /// or infinite values.
    pub fn new(
        frame: &Frame,
        denoised: &[f32],
        reference_residual: Option<f64>,
    ) -> Result<Self, DenoiseError> {
        Self::measure(frame, denoised, &[], reference_residual, Score::headline)
    }

    /// All metrics of `frame`, its denoised image and its baselines.
    ///
    /// # Shapes
    /// `denoised` and each baseline are planar `[3, H, W]` in linear HDR.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn full(
        frame: &Frame,
        denoised: &[f32],
        baselines: &[(&str, &[f32])],
        reference_residual: Option<f64>,
    ) -> Result<Self, DenoiseError> {
        Self::measure(frame, denoised, baselines, reference_residual, Score::full)
    }

    fn measure(
        frame: &Frame,
        denoised: &[f32],
        baselines: &[(&str, &[f32])],
        reference_residual: Option<f64>,
        score: fn(&Image, &Image) -> Score,
    ) -> Result<Self, DenoiseError> {
        let reference = reference_of(frame)?;
        let zeros = vec![0.0; reference.hdr().len()];
        let score = |what, planes| Ok(score(&image_of(frame, what, planes)?, &reference));
        let baselines = baselines
            .iter()
            .map(|(name, planes)| Ok(((*name).to_owned(), score(name, planes)?)));
        Ok(Self {
            name: frame.name.clone(),
            base: None,
            noisy: score("noisy image", &frame.color)?,
            black: score("black image", &zeros)?,
            denoised: score("denoised image", denoised)?,
            baselines: baselines.collect::<Result<_, DenoiseError>>()?,
            reference_residual,
        })
    }

    /// The score of a view of the base scene `base`.
    #[must_use]
    pub fn with_base(self, base: &str) -> Self {
        let base = Some(base.to_owned());
        Self { base, ..self }
    }

    /// The base scene: images with the same one count as one value in comparisons.
    pub fn base_scene(&self) -> &str {
        self.base.as_ref().unwrap_or(&self.name)
    }

    /// All scores by name: `noisy`, `black`, the baselines, `denoised`.
    pub fn methods(&self) -> Vec<(&str, &Score)> {
        methods(&self.noisy, &self.black, &self.baselines, &self.denoised)
    }
}

fn methods<'a>(
    noisy: &'a Score,
    black: &'a Score,
    baselines: &'a BTreeMap<String, Score>,
    denoised: &'a Score,
) -> Vec<(&'a str, &'a Score)> {
    let baselines = baselines.iter().map(|(name, score)| (name.as_str(), score));
    [("noisy", noisy), ("black", black)]
        .into_iter()
        .chain(baselines)
        .chain([("denoised", denoised)])
        .collect()
}

pub(crate) fn image_of<'a>(
    frame: &Frame,
    what: &str,
    planes: &'a [f32],
) -> Result<Image<'a>, DenoiseError> {
    Image::new(planes, frame.height, frame.width).map_err(|source| DenoiseError::Image {
        name: frame.name.clone(),
        what: what.to_owned(),
        source,
    })
}

pub(crate) fn reference_of(frame: &Frame) -> Result<Image<'_>, DenoiseError> {
    let no_reference = || DenoiseError::NoReference {
        name: frame.name.clone(),
    };
    let planes = frame.reference.as_deref().ok_or_else(no_reference)?;
    image_of(frame, "reference", planes)
}

/// Denoises `frame` and computes RelMSE and SSIM.
///
/// # Errors
/// As [`Bundle::denoise`] and [`ImageScore::new`].
pub fn score(
    bundle: &Bundle,
    frame: &Frame,
    reference_residual: Option<f64>,
) -> Result<ImageScore, DenoiseError> {
    ImageScore::new(frame, &bundle.denoise(frame)?, reference_residual)
}

/// Mean scores over a report's images.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MeanScore {
    /// Mean score of the inputs.
    pub noisy: Score,
    /// Mean score of all-zero images.
    pub black: Score,
    /// Mean score of the network's outputs.
    pub denoised: Score,
    /// Mean scores of other programs' images, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub baselines: BTreeMap<String, Score>,
}

impl MeanScore {
    /// All mean scores by name, as [`ImageScore::methods`].
    pub fn methods(&self) -> Vec<(&str, &Score)> {
        methods(&self.noisy, &self.black, &self.baselines, &self.denoised)
    }
}

/// An image that was not scored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FailedImage {
    /// The image.
    pub name: String,
    /// Why, in one line.
    pub error: String,
}

/// The scores of several images and their mean.
///
/// [`Display`](std::fmt::Display) gives a Markdown table of RelMSE and SSIM. The JSON is
/// `{"images": [...], "mean": {...}}`, and `"failed": [...]` if there are any.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// One entry per image, in the given order.
    pub images: Vec<ImageScore>,
    /// Their mean with equal weights.
    pub mean: MeanScore,
    /// The images without scores.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failed: Vec<FailedImage>,
}

impl Report {
    /// The report on these images, which have the same baselines.
    pub fn new(images: Vec<ImageScore>) -> Self {
        let mean_of = |score: &dyn Fn(&ImageScore) -> Option<&Score>| {
            Score::mean(&images.iter().filter_map(score).collect::<Vec<_>>())
        };
        let names = images.first().map(|image| image.baselines.keys());
        let baselines = names.into_iter().flatten().map(|name| {
            let mean = mean_of(&|image| image.baselines.get(name));
            (name.clone(), mean)
        });
        let mean = MeanScore {
            noisy: mean_of(&|image| Some(&image.noisy)),
            black: mean_of(&|image| Some(&image.black)),
            denoised: mean_of(&|image| Some(&image.denoised)),
            baselines: baselines.collect(),
        };
        Self {
            images,
            mean,
            failed: Vec::new(),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn image(name: &str, relmse: f64, ssim: Option<f64>) -> ImageScore {
        let score = Score {
            relmse,
            ssim,
            others: BTreeMap::new(),
        };
        ImageScore {
            name: name.into(),
            base: None,
            noisy: score.clone(),
            black: score.clone(),
            denoised: score,
            baselines: BTreeMap::new(),
            reference_residual: Some(0.1),
        }
    }

    #[test]
    fn the_mean_counts_every_image_once_and_skips_a_missing_ssim() {
        let report = Report::new(vec![image("a", 1.0, Some(0.5)), image("b", 3.0, None)]);
        let expected = Score {
            relmse: 2.0,
            ssim: Some(0.5),
            others: BTreeMap::new(),
        };
        assert_eq!(report.mean.denoised, expected);
        assert_eq!(report.mean.noisy, expected);
    }

    #[test]
    fn a_frame_without_reference_is_named() {
        let frame = crate::bundle::testing::frame(4, 4);
        let error = ImageScore::new(&frame, &frame.color, None).expect_err("no reference");
        assert_eq!(error.to_string(), "pattern: no reference in the file");
    }

    #[test]
    fn json_has_every_metric_and_survives_a_round_trip() {
        let mut frame = crate::bundle::testing::frame(50, 44);
        frame.reference = Some(frame.color.iter().map(|x| x + 0.1).collect());
        let other = vec![0.25; frame.color.len()];
        let baselines = [("other", other.as_slice())];
        let score = ImageScore::full(&frame, &frame.color, &baselines, None).expect("scored");
        assert_eq!(score.denoised, score.noisy);
        let report = Report::new(vec![score]);
        let json = serde_json::to_value(&report).expect("JSON");
        for metric in METRICS {
            assert!(
                json["mean"]["baselines"]["other"][metric.name].is_f64(),
                "{json}"
            );
            assert!(json["images"][0]["noisy"][metric.name].is_f64(), "{json}");
        }
        let back: Report = serde_json::from_value(json).expect("a report");
        assert_eq!(back, report);
    }

    #[test]
    fn a_candidate_that_is_not_finite_is_named_and_counted() {
        let mut frame = crate::bundle::testing::frame(4, 4);
        frame.reference = Some(frame.color.clone());
        let mut bad = frame.color.clone();
        bad[3] = f32::NAN;
        let baselines = [("other", bad.as_slice())];
        let error = ImageScore::full(&frame, &frame.color, &baselines, None).expect_err("NaN");
        let source = std::error::Error::source(&error).expect("a source");
        assert_eq!(
            format!("{error}: {source}"),
            "pattern: other: 1 NaN or infinite values in 1 pixels"
        );
    }
}
