//! Paired differences between the denoised image and another, over base scenes.

use demc_model::metrics::{METRICS, Metric};
use serde::Serialize;

use super::score::{ImageScore, Report, Score};
use crate::statistics::{Estimate, FEWEST_BASES, holm};

/// The difference between the denoised image and another in one metric.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The other image's name.
    pub against: String,
    /// The metric's name. For `energy-bias`, distances from zero are compared.
    pub metric: &'static str,
    /// The change from the other to the denoised image.
    #[serde(flatten)]
    pub estimate: Estimate,
    /// Whether a difference is claimed.
    pub claimed: bool,
    /// The result as text.
    pub verdict: String,
}

impl Report {
    /// Differences between the denoised image and the noisy one and each baseline, in every metric
    /// that both have on at least two base scenes. Holm's correction is over the comparisons of a
    /// metric.
    pub fn differences(&self) -> Vec<Difference> {
        let methods = self.mean.methods();
        let others = methods.iter().map(|(name, _)| *name);
        let others: Vec<&str> = others
            .filter(|name| !matches!(*name, "black" | "denoised"))
            .collect();
        let mut differences: Vec<(usize, Difference)> = Vec::new();
        for metric in &METRICS {
            let compared = others.iter().enumerate();
            let mut estimates: Vec<_> = compared
                .filter_map(|(rank, against)| Some((rank, self.estimate(against, metric)?)))
                .collect();
            holm(estimates.iter_mut().map(|(_, estimate)| estimate));
            differences.extend(estimates.into_iter().map(|(rank, estimate)| {
                let difference = Difference {
                    against: others[rank].to_owned(),
                    metric: metric.name,
                    claimed: estimate.is_claimed(),
                    verdict: estimate.verdict(metric.name, metric.better),
                    estimate,
                };
                (rank, difference)
            }));
        }
        // The sort is stable: by method, then in the order of the metrics.
        differences.sort_by_key(|(rank, _)| *rank);
        differences.into_iter().map(|(_, found)| found).collect()
    }

    /// The change from the image `against` to the denoised one in `metric`.
    fn estimate(&self, against: &str, metric: &Metric) -> Option<Estimate> {
        let value = |score: &Score| {
            let value = score.get(metric.name)?;
            Some(metric.better.comparable(value))
        };
        let pair = |image: &ImageScore| {
            let mut methods = image.methods().into_iter();
            let (_, other) = methods.find(|(name, _)| *name == against)?;
            Some((value(&image.denoised)?, value(other)?))
        };
        let (mut bases, mut ours, mut theirs) = (Vec::new(), Vec::new(), Vec::new());
        for image in &self.images {
            if let Some((our, their)) = pair(image) {
                bases.push(image.base_scene());
                ours.push(our);
                theirs.push(their);
            }
        }
        Estimate::compare(metric.better, &[ours], &[theirs], &bases)
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
                return format!("denoised against {name}: one base scene gives no interval");
            };
            let Estimate { images, bases, .. } = first.estimate;
            let few = if bases < FEWEST_BASES {
                format!("; fewer than {FEWEST_BASES} base scenes cannot show a difference")
            } else {
                String::new()
            };
            let verdicts: Vec<_> = selected.iter().map(|d| d.verdict.as_str()).collect();
            format!(
                "denoised against {name}, {images} images of {bases} base scenes: {}{few}",
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
    fn a_constant_ratio_is_claimed_and_a_mixed_one_is_not() {
        let pairs: Vec<_> = (1..=8)
            .map(|x| (f64::from(x), 2.0 * f64::from(x)))
            .collect();
        let better = report(&pairs);
        let found = better.differences();
        let other = found.iter().find(|d| d.against == "other").expect("relmse");
        assert_eq!((other.metric, other.estimate.images), ("relmse", 8));
        assert!(
            (other.estimate.mean + 0.5).abs() < 1e-12,
            "half of the error"
        );
        assert!(other.claimed);
        // 2 / 2^8 by the sign-flip test, times two comparisons only if both are as small.
        assert_eq!(
            better.sentences(&["relmse"]),
            ["denoised against other, 8 images of 8 base scenes: \
                 better in relmse (-50.0 %, 95 % interval -50.0 % to -50.0 %, p = 0.016)"]
        );
        let mixed = report(&[(1.0, 1.5), (3.0, 2.5), (9.0, 9.1)]);
        let sentence = mixed.sentences(&["relmse"]).remove(0);
        assert!(
            sentence.contains("no difference shown in relmse"),
            "{sentence}"
        );
        assert!(sentence.ends_with("fewer than 6 base scenes cannot show a difference"));
    }

    #[test]
    fn views_of_one_base_scene_count_as_one_value() {
        let pairs = [(1.0, 2.0), (1.0, 2.0), (1.0, 2.0), (4.0, 1.0)];
        let mut report = report(&pairs);
        for image in &mut report.images[..3] {
            image.base = Some("room".into());
        }
        let found = report.differences();
        let other = found.iter().find(|d| d.against == "other").expect("relmse");
        assert_eq!((other.estimate.images, other.estimate.bases), (4, 2));
        // The square root of 1/2 x 4.
        assert!((other.estimate.mean - (2.0_f64.sqrt() - 1.0)).abs() < 1e-12);
    }

    #[test]
    fn one_image_gives_no_interval() {
        let one = report(&[(1.0, 1.5)]);
        assert_eq!(one.differences(), []);
        let sentence = one.sentences(&["relmse"]).remove(0);
        assert!(
            sentence.ends_with("one base scene gives no interval"),
            "{sentence}"
        );
    }
}
