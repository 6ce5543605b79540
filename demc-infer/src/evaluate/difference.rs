//! Paired differences between the denoised image and another, with a bootstrap interval over
//! images.

use demc_model::metrics::METRICS;
use serde::Serialize;

use super::score::{ImageScore, Report, Score};
use crate::statistics::Estimate;

/// Number of images below which a bootstrap interval is too narrow (Hesterberg 2015). Reports say
/// so.
pub const FEW_IMAGES: usize = 10;

/// The mean difference between the denoised image and another in one metric.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The other image's name.
    pub against: String,
    /// The metric's name. For `energy-bias`, distances from zero are compared.
    pub metric: &'static str,
    /// Number of images with a score for both.
    pub images: usize,
    /// Denoised minus the other, and its 95 % interval over images.
    #[serde(flatten)]
    pub estimate: Estimate,
    /// Whether the interval excludes zero.
    pub significant: bool,
    /// The result as text.
    pub verdict: String,
}

impl Report {
    /// Differences between the denoised image and the noisy one and each baseline, in every metric
    /// that both have on at least two images.
    pub fn differences(&self) -> Vec<Difference> {
        self.mean
            .methods()
            .into_iter()
            .map(|(name, _)| name)
            .filter(|name| !matches!(*name, "black" | "denoised"))
            .flat_map(|against| METRICS.iter().map(move |metric| (against, metric)))
            .filter_map(|(against, metric)| {
                let value = |score: &Score| {
                    let value = score.get(metric.name)?;
                    Some(metric.better.comparable(value))
                };
                let pair = |image: &ImageScore| {
                    let mut methods = image.methods().into_iter();
                    let (_, other) = methods.find(|(name, _)| *name == against)?;
                    Some((value(&image.denoised)?, value(other)?))
                };
                let (ours, theirs): (Vec<_>, Vec<_>) = self.images.iter().filter_map(pair).unzip();
                let images = ours.len();
                let estimate =
                    Estimate::of_difference(&[ours], &[theirs]).filter(|_| images > 1)?;
                Some(Difference {
                    against: against.to_owned(),
                    metric: metric.name,
                    images,
                    estimate,
                    significant: estimate.is_significant(),
                    verdict: estimate.verdict(metric.name, metric.better),
                })
            })
            .collect()
    }

    /// One sentence per baseline about the differences in `metrics`; empty without baselines.
    pub fn sentences(&self, metrics: &[&str]) -> Vec<String> {
        let differences = self.differences();
        let sentence = |name: &String| {
            let selected: Vec<_> = differences
                .iter()
                .filter(|d| d.against == *name && metrics.contains(&d.metric))
                .collect();
            let Some(first) = selected.first() else {
                return format!("denoised against {name}: one image gives no interval");
            };
            let few = match first.images {
                ..FEW_IMAGES => {
                    format!("; intervals from fewer than {FEW_IMAGES} images are too narrow")
                }
                _ => String::new(),
            };
            let verdicts: Vec<_> = selected.iter().map(|d| d.verdict.as_str()).collect();
            format!(
                "denoised against {name}, {} images: {}{few}",
                first.images,
                verdicts.join("; ")
            )
        };
        self.mean.baselines.keys().map(sentence).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::score::tests::image;
    use super::*;

    fn report(pairs: &[(f64, f64)]) -> Report {
        let score = |(i, &(ours, theirs)): (usize, &(f64, f64))| {
            let mut score = image(&format!("image {i}"), ours, None);
            let other = Score {
                relmse: theirs,
                ..score.noisy.clone()
            };
            score.baselines.insert("other".into(), other);
            score
        };
        Report::new(pairs.iter().enumerate().map(score).collect())
    }

    #[test]
    fn a_constant_difference_is_significant_and_a_mixed_one_is_not() {
        let better = report(&[(1.0, 1.5), (3.0, 3.5), (9.0, 9.5)]);
        let found = better.differences();
        let other = found.iter().find(|d| d.against == "other").expect("relmse");
        assert_eq!((other.metric, other.images), ("relmse", 3));
        assert_eq!(other.estimate.mean, -0.5);
        assert!(other.significant);
        assert_eq!(
            better.sentences(&["relmse"]),
            [
                "denoised against other, 3 images: better in relmse (-0.5000, 95 % -0.5000 to -0.5000); \
                 intervals from fewer than 10 images are too narrow"
            ]
        );
        let mixed = report(&[(1.0, 1.5), (3.0, 2.5), (9.0, 9.1)]);
        let sentence = mixed.sentences(&["relmse"]).remove(0);
        assert!(
            sentence.contains("no significant difference in relmse"),
            "{sentence}"
        );
    }

    #[test]
    fn one_image_gives_no_interval() {
        let one = report(&[(1.0, 1.5)]);
        assert_eq!(one.differences(), []);
        let sentence = one.sentences(&["relmse"]).remove(0);
        assert!(
            sentence.ends_with("one image gives no interval"),
            "{sentence}"
        );
    }
}
