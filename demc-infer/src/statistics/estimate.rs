//! The difference of two variants in one metric: its mean, interval, and p-values.

use demc_model::metrics::Better;
use serde::{Deserialize, Serialize};

use super::bootstrap::Bootstrap;
use super::paired::PairedDifferences;
use super::sign_flip;

/// Number of resamples per interval (ours).
pub const RESAMPLES: usize = 10_000;
/// The sign-flip test of fewer base scenes cannot reach 5 %: 2 / 2^5 is 6 %.
pub const FEWEST_BASES: usize = 6;
/// Probability of a wrong claim, and of an interval that misses the true mean.
const OUTSIDE: f64 = 0.05;
/// Smaller errors count as this one, because an error of zero has no logarithm (ours).
const SMALLEST_ERROR: f64 = 1e-6;

/// How two values of a metric are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scale {
    /// By their ratio. Means are of logarithms, so that each image has the same weight: the ratio of
    /// two geometric means.
    Ratio,
    /// By their difference.
    Difference,
}

impl Scale {
    /// Errors, of which smaller ones are better, by their ratio; other metrics by their difference.
    pub fn of(better: Better) -> Self {
        match better {
            Better::Lower => Scale::Ratio,
            Better::Higher | Better::Zero => Scale::Difference,
        }
    }

    /// A value of a metric on the scale of the means.
    fn value(self, value: f64) -> f64 {
        match self {
            Scale::Ratio => value.max(SMALLEST_ERROR).ln(),
            Scale::Difference => value,
        }
    }

    /// The value of a metric for a mean of [`value`](Self::value)s: a geometric or plain mean.
    fn mean(self, mean: f64) -> f64 {
        match self {
            Scale::Ratio => mean.exp(),
            Scale::Difference => mean,
        }
    }

    /// A difference of means for readers: a relative change, or the difference.
    fn change(self, difference: f64) -> f64 {
        match self {
            Scale::Ratio => difference.exp_m1(),
            Scale::Difference => difference,
        }
    }

    /// A change as text: `+3.1 %` or `+0.0031`.
    pub fn text(self, change: f64) -> String {
        match self {
            Scale::Ratio => format!("{:+.1} %", 100.0 * change),
            Scale::Difference => format!("{change:+.4}"),
        }
    }
}

/// The mean of a metric over base scenes and seeds. Each base scene counts once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Average {
    /// Mean: geometric for errors, of which smaller ones are better.
    pub mean: f64,
    /// Lower and upper end of its 95 % interval; `None` for fewer than two base scenes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interval: Option<[f64; 2]>,
    /// Mean of each seed.
    pub of_seeds: Vec<f64>,
}

impl Average {
    /// The mean of `values[seed][image]`; `bases` has the base scene of each image. `None` without a
    /// value.
    ///
    /// # Panics
    /// If a row and `bases` differ in length.
    pub fn of(better: Better, values: &[Vec<f64>], bases: &[&str]) -> Option<Self> {
        let scale = Scale::of(better);
        let rows = values.iter().map(|row| -> Vec<f64> {
            let scaled = row.iter().map(|value| scale.value(*value));
            scaled.collect()
        });
        let table = PairedDifferences::new(&rows.collect::<Vec<_>>(), bases)?;
        let of_seeds = table
            .of_seeds
            .iter()
            .map(|seed| scale.mean(table.mean + seed));
        let interval = Bootstrap::new(&table, RESAMPLES)
            .map(|bootstrap| bootstrap.interval(OUTSIDE).map(|end| scale.mean(end)));
        Some(Self {
            mean: scale.mean(table.mean),
            interval,
            of_seeds: of_seeds.collect(),
        })
    }
}

/// The paired difference of two variants in one metric. Each base scene counts once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Whether the changes are relative: `-0.1` is 10 % less.
    pub scale: Scale,
    /// Mean change.
    pub mean: f64,
    /// Lower and upper end of its 95 % interval.
    pub interval: [f64; 2],
    /// Smallest change that would be found with a probability of 80 % at the two-sided level of 5 %,
    /// before Holm's correction.
    pub detectable: f64,
    /// Smallest level at which the interval excludes zero.
    pub p_bootstrap: f64,
    /// P-value of the sign-flip test over base scenes.
    pub p_sign_flip: f64,
    /// The larger p-value of both, after [`holm`].
    pub p: f64,
    /// Number of seeds. A single one gives no variation between seeds.
    pub seeds: usize,
    /// Number of base scenes.
    pub bases: usize,
    /// Number of images.
    pub images: usize,
    /// The base scene without which the mean has the other sign.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub decided_by: Option<Decisive>,
}

/// A base scene that decides the sign of a mean.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Decisive {
    /// Its name.
    pub base: String,
    /// Mean change of the other base scenes.
    pub without: f64,
}

impl Estimate {
    /// The change from `theirs` to `ours`, both `[seed][image]`; `bases` has the base scene of each
    /// image. `None` for fewer than two base scenes.
    ///
    /// # Panics
    /// If the tables and `bases` differ in size.
    pub fn compare(
        better: Better,
        ours: &[Vec<f64>],
        theirs: &[Vec<f64>],
        bases: &[&str],
    ) -> Option<Self> {
        assert_eq!(ours.len(), theirs.len(), "tables of the same seeds");
        let scale = Scale::of(better);
        let rows = ours.iter().zip(theirs).map(|(ours, theirs)| -> Vec<f64> {
            assert_eq!(ours.len(), theirs.len(), "tables of the same images");
            let pairs = ours.iter().zip(theirs);
            pairs
                .map(|(ours, theirs)| scale.value(*ours) - scale.value(*theirs))
                .collect()
        });
        let table = PairedDifferences::new(&rows.collect::<Vec<_>>(), bases)?;
        Self::of(&table, scale, bases.len(), RESAMPLES)
    }

    /// The estimate of a table of differences; `None` for fewer than two base scenes.
    pub(super) fn of(
        table: &PairedDifferences,
        scale: Scale,
        images: usize,
        resamples: usize,
    ) -> Option<Self> {
        let bootstrap = Bootstrap::new(table, resamples)?;
        let of_bases: Vec<f64> = table.of_bases.iter().map(|x| table.mean + x).collect();
        let p_bootstrap = bootstrap.p_value();
        let p_sign_flip = sign_flip::p_value(&of_bases);
        Some(Self {
            scale,
            mean: scale.change(table.mean),
            interval: bootstrap.interval(OUTSIDE).map(|end| scale.change(end)),
            detectable: scale.change(bootstrap.detectable(OUTSIDE)),
            p_bootstrap,
            p_sign_flip,
            p: p_bootstrap.max(p_sign_flip),
            seeds: table.cells.len(),
            bases: table.bases.len(),
            images,
            decided_by: decisive(table, scale),
        })
    }

    /// Whether a difference is claimed: bootstrap and sign-flip test agree, after Holm's correction.
    pub fn is_claimed(&self) -> bool {
        self.p <= OUTSIDE
    }

    /// Whether `better` prefers the mean.
    pub fn is_better(&self, better: Better) -> bool {
        better.prefers(self.mean)
    }

    /// The interval as text, such as `-3.1 % to +2.0 %`.
    pub fn interval_text(&self) -> String {
        self.interval.map(|end| self.scale.text(end)).join(" to ")
    }

    /// The smallest detectable change as text, without a sign.
    pub fn detectable_text(&self) -> String {
        self.scale.text(self.detectable).replace('+', "")
    }

    /// The change in `metric` as text, and whether it is claimed.
    pub fn verdict(&self, metric: &str, better: Better) -> String {
        let mean = self.scale.text(self.mean);
        let found = format!("{mean}, 95 % interval {}", self.interval_text());
        if self.is_claimed() {
            let word = if self.is_better(better) {
                "better"
            } else {
                "worse"
            };
            let p = if self.p < 0.001 {
                "p < 0.001".to_owned()
            } else {
                format!("p = {:.3}", self.p)
            };
            return format!("{word} in {metric} ({found}, {p})");
        }
        let detectable = self.detectable_text();
        let text = format!("no difference shown in {metric} ({found}; detectable: {detectable})");
        match &self.decided_by {
            None => text,
            Some(Decisive { base, without }) => {
                let without = self.scale.text(*without);
                format!("{text}, and without base scene {base} its sign changes ({without})")
            }
        }
    }
}

/// The base scene without which the mean moves furthest beyond zero, if one decides its sign.
fn decisive(table: &PairedDifferences, scale: Scale) -> Option<Decisive> {
    let others = table.bases.iter().enumerate();
    let means = others.map(|(number, base)| (base, table.without(number)));
    let (base, without) = means
        .filter(|(_, without)| without * table.mean < 0.0)
        .max_by(|(_, a), (_, b)| a.abs().total_cmp(&b.abs()))?;
    Some(Decisive {
        base: base.clone(),
        without: scale.change(without),
    })
}

/// Holm's correction (1979) of the p-values of comparisons that are claimed together. Each is
/// multiplied by the number of comparisons that are not smaller, and is at least the one before it.
pub fn holm<'a>(estimates: impl IntoIterator<Item = &'a mut Estimate>) {
    let mut sorted: Vec<&mut Estimate> = estimates.into_iter().collect();
    sorted.sort_by(|a, b| a.p.total_cmp(&b.p));
    let count = sorted.len();
    let mut largest: f64 = 0.0;
    for (rank, estimate) in sorted.into_iter().enumerate() {
        largest = largest.max(estimate.p * (count - rank) as f64).min(1.0);
        estimate.p = largest;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn compared(better: Better, pairs: &[(f64, f64)]) -> Estimate {
        let (ours, theirs): (Vec<f64>, Vec<f64>) = pairs.iter().copied().unzip();
        let names = crate::statistics::tests::names(pairs.len());
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        Estimate::compare(better, &[ours], &[theirs], &names).expect("base scenes")
    }

    #[test]
    fn errors_are_compared_by_their_ratio() {
        let found = compared(Better::Lower, &[(0.5, 1.0), (8.0, 4.0), (1.0, 4.0)]);
        // The geometric mean of 1/2, 2, and 1/4.
        assert!(
            (found.mean - (0.25_f64.cbrt() - 1.0)).abs() < 1e-12,
            "{found:?}"
        );
        let plain = compared(Better::Higher, &[(0.5, 1.0), (8.0, 4.0), (1.0, 4.0)]);
        assert!((plain.mean - 0.5 / 3.0).abs() < 1e-12, "{plain:?}");
        let zero = compared(Better::Lower, &[(0.0, 1e-6), (0.0, 1e-6)]);
        assert_eq!((zero.mean, zero.interval, zero.p), (0.0, [0.0; 2], 1.0));
    }

    /// Six base scenes are the fewest whose sign-flip test can reach 5 %: 2 / 2^6 = 3.1 %.
    #[test]
    fn a_claim_needs_both_tests() {
        let five = compared(Better::Higher, &[(2.0, 1.0); 5]);
        assert!(five.p_bootstrap <= 1e-6 && five.p_sign_flip == 0.0625);
        assert!(!five.is_claimed());
        let six = compared(Better::Higher, &[(2.0, 1.0); 6]);
        assert!(six.is_claimed() && six.p == 0.03125);
        assert_eq!(
            six.verdict("ssim", Better::Higher),
            "better in ssim (+1.0000, 95 % interval +1.0000 to +1.0000, p = 0.031)"
        );
        let many = compared(Better::Higher, &[(2.0, 1.0); 12]);
        assert!(
            many.verdict("ssim", Better::Higher)
                .ends_with(", p < 0.001)")
        );
        assert!(
            six.verdict("flip", Better::Lower)
                .starts_with("worse in flip")
        );
        assert_eq!(
            five.verdict("ssim", Better::Higher),
            "no difference shown in ssim (+1.0000, 95 % interval +1.0000 to +1.0000; detectable: 0.0000)"
        );
    }

    /// The geometric mean of base scenes sqrt(1 x 4) and 8; the plain mean of 2.5 and 8.
    #[test]
    fn averages_are_geometric_for_errors() {
        let values = [vec![1.0, 4.0, 8.0]];
        let average = |better| Average::of(better, &values, &["a", "a", "b"]).expect("values");
        assert!((average(Better::Lower).mean - 4.0).abs() < 1e-12);
        assert_eq!(average(Better::Higher).mean, 5.25);
        assert_eq!(average(Better::Higher).of_seeds, [5.25]);
        let [low, high] = average(Better::Lower).interval.expect("two base scenes");
        assert!(0.0 < low && low < 4.0 && high > 4.0, "{low} {high}");
    }

    #[test]
    fn a_base_scene_that_decides_the_sign_is_named() {
        let found = compared(Better::Higher, &[(0.0, 1.0), (0.0, 1.0), (9.0, 1.0)]);
        let decisive = found.decided_by.as_ref().expect("the last one");
        assert_eq!(
            (decisive.base.as_str(), decisive.without),
            ("scene 2", -1.0)
        );
        let text = found.verdict("ssim", Better::Higher);
        assert!(
            text.ends_with("and without base scene scene 2 its sign changes (-1.0000)"),
            "{text}"
        );
        let steady = compared(Better::Higher, &[(2.0, 1.0), (3.0, 1.0), (4.0, 1.0)]);
        assert_eq!(steady.decided_by, None);
    }

    #[test]
    fn one_base_scene_gives_no_estimate() {
        let [ours, theirs] = [[vec![1.0, 2.0]], [vec![3.0, 4.0]]];
        let found = Estimate::compare(Better::Lower, &ours, &theirs, &["a", "a"]);
        assert_eq!(found, None);
    }

    /// The example of Holm (1979) with level 5 %: 0.01 x 4, 0.02 x 3, then no smaller one.
    #[test]
    fn holm_multiplies_by_the_comparisons_that_are_left() {
        let one = compared(Better::Higher, &[(2.0, 1.0); 6]);
        let mut all = [0.02, 0.6, 0.01, 0.025].map(|p| Estimate { p, ..one.clone() });
        holm(&mut all);
        let found = all.map(|estimate| estimate.p);
        for (found, expected) in found.iter().zip([0.06, 0.6, 0.04, 0.06]) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
    }
}
