//! Paired differences of the denoised image from another, image by image, with a bootstrap interval.

use demc_model::metrics::METRICS;
use serde::Serialize;

use super::{ImageScore, Report, Score};
use crate::statistics::Estimate;

/// Below this many images a bootstrap interval is known to be too narrow (Hesterberg 2015), and it is said.
pub const FEW_IMAGES: usize = 10;

/// The mean difference of the denoised image from another in one metric.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// What the denoised image is compared with.
    pub against: String,
    /// The metric's name. Of `energy-bias`, distances from zero are compared.
    pub metric: &'static str,
    /// Images that both have a score of.
    pub images: usize,
    /// Denoised minus the other, and its 95 % interval over images.
    #[serde(flatten)]
    pub estimate: Estimate,
    /// Whether zero lies outside of the interval.
    pub significant: bool,
    /// The same in words.
    pub verdict: String,
}

impl Report {
    /// Differences of the denoised image from the noisy one and from each baseline, in every metric that both have on two
    /// images or more: one image says nothing of others.
    pub fn differences(&self) -> Vec<Difference> {
        let others = self.mean.methods().into_iter().map(|(name, _)| name);
        let others = others.filter(|name| !matches!(*name, "black" | "denoised"));
        others
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

    /// What the differences from the baselines say in `metrics`, a sentence a baseline; none without baselines.
    pub fn sentences(&self, metrics: &[&str]) -> Vec<String> {
        let differences = self.differences();
        let sentence = |name: &String| {
            let of_it = differences.iter().filter(|d| d.against == *name);
            let asked: Vec<_> = of_it.filter(|d| metrics.contains(&d.metric)).collect();
            let Some(first) = asked.first() else {
                return format!("denoised against {name}: one image says nothing of others");
            };
            let few = match first.images {
                ..FEW_IMAGES => "; so few images give intervals that are too narrow",
                _ => "",
            };
            let verdicts: Vec<_> = asked.iter().map(|d| d.verdict.as_str()).collect();
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
    use super::super::tests::image;
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
        let of_other = found.iter().find(|d| d.against == "other").expect("relmse");
        assert_eq!((of_other.metric, of_other.images), ("relmse", 3));
        assert_eq!(of_other.estimate.mean, -0.5);
        assert!(of_other.significant);
        assert_eq!(
            better.sentences(&["relmse"]),
            [
                "denoised against other, 3 images: better in relmse (-0.5000, 95 % -0.5000 to -0.5000); so few images give intervals that are too narrow"
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
            sentence.ends_with("one image says nothing of others"),
            "{sentence}"
        );
    }
}
