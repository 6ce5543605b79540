//! Means and paired differences with bootstrap intervals (Efron 1979) over images and seeds.
//!
//! A table of scores has one row per seed and one column per image. A resample draws seeds and
//! images independently and with replacement, and takes the mean over their cells. The interval
//! lies between the 2.5 % and 97.5 % quantiles of these means. Comparisons are paired: a cell is
//! the difference of two variants on the same image, trained from the same seed on the same
//! batches.

use demc_model::metrics::Better;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Number of resamples per interval (ours).
pub const RESAMPLES: usize = 10_000;
/// Share of the resampled means outside an interval.
const OUTSIDE: f64 = 0.05;
/// Seed of the resampling, for reproducible tables.
const SEED: u64 = 1;

/// A mean and its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Mean of all cells.
    pub mean: f64,
    /// Lower and upper end of the interval.
    pub interval: [f64; 2],
}

impl Estimate {
    /// The mean of `scores[seed][image]` with its interval; `None` for an empty table.
    ///
    /// # Panics
    /// If rows differ in length.
    pub fn of(scores: &[Vec<f64>]) -> Option<Self> {
        let (seeds, images) = (scores.len(), scores.first()?.len());
        if images == 0 {
            return None;
        }
        assert!(scores.iter().all(|row| row.len() == images), "a full table");
        let mean = |rows: &[usize], columns: &[usize]| {
            let cells = rows
                .iter()
                .flat_map(|row| columns.iter().map(|c| scores[*row][*c]));
            cells.sum::<f64>() / (rows.len() * columns.len()) as f64
        };
        let mut rng = ChaCha8Rng::seed_from_u64(SEED);
        let mut draw = |count: usize| -> Vec<usize> {
            (0..count).map(|_| rng.random_range(0..count)).collect()
        };
        let mut means: Vec<f64> = (0..RESAMPLES)
            .map(|_| mean(&draw(seeds), &draw(images)))
            .collect();
        means.sort_by(f64::total_cmp);
        let all = |count: usize| (0..count).collect::<Vec<_>>();
        Some(Estimate {
            mean: mean(&all(seeds), &all(images)),
            interval: [OUTSIDE / 2.0, 1.0 - OUTSIDE / 2.0].map(|share| quantile(&means, share)),
        })
    }

    /// The paired difference `a - b`; `None` for empty tables.
    ///
    /// # Panics
    /// If the tables differ in size.
    pub fn of_difference(a: &[Vec<f64>], b: &[Vec<f64>]) -> Option<Self> {
        assert_eq!(a.len(), b.len(), "tables of the same seeds");
        let rows = a.iter().zip(b).map(|(a, b)| {
            assert_eq!(a.len(), b.len(), "tables of the same images");
            a.iter().zip(b).map(|(a, b)| a - b).collect()
        });
        Self::of(&rows.collect::<Vec<_>>())
    }

    /// A difference in `metric` as text, with its significance.
    pub fn verdict(&self, metric: &str, better: Better) -> String {
        let word = match (self.is_significant(), better.prefers(self.mean)) {
            (false, _) => "no significant difference",
            (true, true) => "better",
            (true, false) => "worse",
        };
        let [low, high] = self.interval;
        let mean = self.mean;
        format!("{word} in {metric} ({mean:+.4}, 95 % {low:+.4} to {high:+.4})")
    }

    /// Whether the interval excludes zero.
    pub fn is_significant(&self) -> bool {
        self.interval[0] > 0.0 || self.interval[1] < 0.0
    }
}

fn quantile(sorted: &[f64], share: f64) -> f64 {
    let position = share * (sorted.len() - 1) as f64;
    let (below, rest) = (position.floor() as usize, position.fract());
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + rest * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn normal(rng: &mut ChaCha8Rng) -> f64 {
        // The sum of 12 uniform numbers has variance 1.
        (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
    }

    #[test]
    fn quantiles_of_a_ramp_are_its_positions() {
        let ramp: Vec<f64> = (0..=100).map(f64::from).collect();
        assert_eq!(quantile(&ramp, 0.025), 2.5);
        assert_eq!(quantile(&ramp, 1.0), 100.0);
    }

    #[test]
    fn equal_scores_have_an_empty_interval_and_an_empty_table_no_mean() {
        let equal = vec![vec![0.25; 3]; 2];
        let found = Estimate::of(&equal).unwrap();
        assert_eq!((found.mean, found.interval), (0.25, [0.25; 2]));
        let difference = Estimate::of_difference(&equal, &equal).unwrap();
        assert!(!difference.is_significant());
        assert_eq!(Estimate::of(&[]), None);
        assert_eq!(Estimate::of(&[vec![]]), None);
    }

    #[test]
    fn a_verdict_respects_the_direction_of_the_metric() {
        let found = |mean, interval| Estimate { mean, interval };
        assert_eq!(
            found(-0.5, [-0.75, -0.25]).verdict("relmse", Better::Lower),
            "better in relmse (-0.5000, 95 % -0.7500 to -0.2500)"
        );
        let worse = found(-0.5, [-0.75, -0.25]).verdict("ssim", Better::Higher);
        assert!(worse.starts_with("worse in ssim"), "{worse}");
        let none = found(-0.5, [-0.75, 0.25]).verdict("flip", Better::Lower);
        assert!(
            none.starts_with("no significant difference in flip"),
            "{none}"
        );
    }

    /// For one seed, the interval is that of the mean of n values: 1.96 deviations / sqrt(n) to
    /// both sides.
    #[test]
    fn interval_of_one_seed_is_that_of_the_central_limit() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let scores: Vec<f64> = (0..100).map(|_| 3.0 + normal(&mut rng)).collect();
        let mean = scores.iter().sum::<f64>() / 100.0;
        let variance = scores.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 100.0;
        let half = 1.96 * (variance / 100.0).sqrt();
        let found = Estimate::of(&[scores]).unwrap();
        assert!((found.mean - mean).abs() < 1e-12);
        let [low, high] = found.interval;
        assert!(
            ((mean - low) / half - 1.0).abs() < 0.06,
            "{found:?}, half {half}"
        );
        assert!(
            ((high - mean) / half - 1.0).abs() < 0.06,
            "{found:?}, half {half}"
        );
    }

    #[test]
    fn pairing_finds_a_small_difference_between_widely_different_images() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let a: Vec<f64> = (0..20).map(|_| 10.0 * normal(&mut rng)).collect();
        let b: Vec<f64> = a
            .iter()
            .map(|x| x + 0.1 + 0.05 * normal(&mut rng))
            .collect();
        let (a, b) = (vec![a], vec![b]);
        let found = Estimate::of_difference(&b, &a).unwrap();
        assert!(
            found.is_significant() && (found.mean - 0.1).abs() < 0.05,
            "{found:?}"
        );
        let [a, b] = [a, b].map(|table| Estimate::of(&table).unwrap());
        assert!(a.interval[1] > b.interval[0], "unpaired they overlap");
    }

    #[test]
    fn seeds_that_disagree_widen_the_interval() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let table = |rng: &mut ChaCha8Rng, effects: [f64; 3]| -> Vec<Vec<f64>> {
            let row = |effect: f64, rng: &mut ChaCha8Rng| {
                (0..50).map(|_| effect + 0.1 * normal(rng)).collect()
            };
            effects.map(|effect| row(effect, rng)).to_vec()
        };
        let agree = Estimate::of(&table(&mut rng, [1.0, 1.0, 1.0])).unwrap();
        let disagree = Estimate::of(&table(&mut rng, [-1.0, 0.5, 2.0])).unwrap();
        assert!(
            agree.is_significant() && !disagree.is_significant(),
            "{disagree:?}"
        );
    }
}
