//! Crossed bootstrap over seeds and base scenes (Owen 2007) with BCa intervals (Efron 1987).
//!
//! A resample draws seeds and base scenes independently and with replacement, and takes the mean
//! over their cells. With few seeds, intervals from resamples alone are too narrow: over 2 seeds
//! their standard deviation is 0.71 of the true one. Therefore no end is nearer to the mean than
//! that of a t interval for a sum of two means (Banerjee 1961). For normal effects, its coverage is
//! at least the nominal one.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::distribution::{normal, normal_quantile, student_quantile};
use super::paired::PairedDifferences;

/// Seed of the resampling, for reproducible tables.
pub(super) const SEED: u64 = 1;
/// The smallest p-value that is reported.
const SMALLEST_P: f64 = 1e-6;
/// Steps of the search for a p-value, for six digits of it.
const SEARCH_STEPS: usize = 24;
/// Power of the smallest detectable effect (ours).
const POWER: f64 = 0.8;

/// The resampled means of a table, and what intervals need.
pub(super) struct Bootstrap<'a> {
    table: &'a PairedDifferences,
    /// Resampled means, sorted.
    means: Vec<f64>,
    /// Bias correction.
    bias: f64,
    /// Acceleration.
    acceleration: f64,
}

impl<'a> Bootstrap<'a> {
    /// `None` for fewer than two base scenes.
    pub fn new(table: &'a PairedDifferences, resamples: usize) -> Option<Self> {
        if table.bases.len() < 2 {
            return None;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(SEED);
        let mut means: Vec<f64> = (0..resamples).map(|_| resample(table, &mut rng)).collect();
        means.sort_by(f64::total_cmp);
        let bias = bias(&means, table.mean);
        Some(Self {
            table,
            means,
            bias,
            acceleration: acceleration(table),
        })
    }

    /// The interval that misses the true mean with probability `outside`.
    pub fn interval(&self, outside: f64) -> [f64; 2] {
        let mean = self.table.mean;
        let half = self.half_width(outside);
        let low = self.end(outside / 2.0).min(mean - half);
        let high = self.end(1.0 - outside / 2.0).max(mean + half);
        [low, high]
    }

    /// The smallest probability `outside` whose interval excludes zero.
    pub fn p_value(&self) -> f64 {
        let excludes = |outside: f64| {
            let [low, high] = self.interval(outside);
            low > 0.0 || high < 0.0
        };
        let [mut includes_at, mut excludes_at] = [SMALLEST_P.ln(), 0.0];
        if excludes(SMALLEST_P) {
            return SMALLEST_P;
        }
        if !excludes(1.0) {
            return 1.0;
        }
        for _ in 0..SEARCH_STEPS {
            let middle = 0.5 * (includes_at + excludes_at);
            if excludes(middle.exp()) {
                excludes_at = middle;
            } else {
                includes_at = middle;
            }
        }
        excludes_at.exp()
    }

    /// The effect that a two-sided test at `outside` finds with a probability of 80 %.
    pub fn detectable(&self, outside: f64) -> f64 {
        self.half_width(outside) + normal_quantile(POWER) * self.standard_error()
    }

    /// Standard error of the mean: the limit of the resamples' standard deviation for many seeds and
    /// base scenes, and unbiased for few.
    pub fn standard_error(&self) -> f64 {
        self.table.variances().iter().sum::<f64>().sqrt()
    }

    /// Half the length of the t interval: each variance counts with the t value of its own degrees
    /// of freedom.
    fn half_width(&self, outside: f64) -> f64 {
        let counts = [self.table.of_seeds.len(), self.table.of_bases.len()];
        let parts = self.table.variances().into_iter().zip(counts);
        let squares = parts
            .filter(|(_, count)| *count > 1)
            .map(|(variance, count)| student_quantile(outside, count - 1).powi(2) * variance);
        squares.sum::<f64>().sqrt()
    }

    /// The end of the BCa interval for `share` of the resampled means.
    fn end(&self, share: f64) -> f64 {
        let moved = self.bias + normal_quantile(share);
        // Positive for every share that is used, except if one cell outweighs all others.
        let slowed = (1.0 - self.acceleration * moved).max(0.05);
        quantile(&self.means, normal(self.bias + moved / slowed))
    }
}

fn resample(table: &PairedDifferences, rng: &mut ChaCha8Rng) -> f64 {
    let (seeds, bases) = (table.cells.len(), table.bases.len());
    let mut counts = vec![0.0; bases];
    for _ in 0..bases {
        counts[rng.random_range(0..bases)] += 1.0;
    }
    let rows = (0..seeds).map(|_| &table.cells[rng.random_range(0..seeds)]);
    let cells = rows.flat_map(|row| row.iter().zip(&counts));
    cells.map(|(cell, count)| cell * count).sum::<f64>() / (seeds * bases) as f64
}

/// The normal quantile of the share of resampled means below the mean.
fn bias(sorted: &[f64], mean: f64) -> f64 {
    let tolerance = 1e-12 * mean.abs();
    let below = sorted.partition_point(|value| *value < mean - tolerance);
    let up_to = sorted.partition_point(|value| *value <= mean + tolerance);
    let share = 0.5 * (below + up_to) as f64 / sorted.len() as f64;
    let smallest = 0.5 / sorted.len() as f64;
    normal_quantile(share.clamp(smallest, 1.0 - smallest))
}

/// A sixth of the skewness of the mean, from the jackknife over both factors.
fn acceleration(table: &PairedDifferences) -> f64 {
    let influences = [&table.of_seeds, &table.of_bases].map(|effects| {
        let count = effects.len() as f64;
        effects.iter().map(move |effect| effect / count)
    });
    let sums = influences
        .into_iter()
        .flatten()
        .fold([0.0; 2], |[squares, cubes], part| {
            [squares + part * part, cubes + part * part * part]
        });
    match sums {
        [0.0, _] => 0.0,
        [squares, cubes] => cubes / (6.0 * squares.powf(1.5)),
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
    use crate::statistics::tests::{names, normal_value};

    const RESAMPLES: usize = 10_000;

    fn table(rows: &[Vec<f64>]) -> PairedDifferences {
        let names = names(rows[0].len());
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        PairedDifferences::new(rows, &names).expect("cells")
    }

    #[test]
    fn quantiles_of_a_ramp_are_its_positions() {
        let ramp: Vec<f64> = (0..=100).map(f64::from).collect();
        assert_eq!(quantile(&ramp, 0.025), 2.5);
        assert_eq!(quantile(&ramp, 1.0), 100.0);
    }

    /// For one seed and many base scenes, the ends lie 1.96 standard errors from the mean.
    #[test]
    fn the_interval_of_many_base_scenes_is_that_of_the_central_limit() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let row: Vec<f64> = (0..200).map(|_| 3.0 + normal_value(&mut rng)).collect();
        let table = table(&[row]);
        let found = Bootstrap::new(&table, RESAMPLES).expect("base scenes");
        let half = 1.96 * found.standard_error();
        for end in found.interval(0.05) {
            let ratio = (end - table.mean).abs() / half;
            assert!((0.99..1.08).contains(&ratio), "{ratio}");
        }
    }

    /// The variance of the crossed bootstrap is (n - 1) / n of each factor's, and the cells' own
    /// noise counts up to three times (Owen 2007). Here it is small.
    #[test]
    fn resampled_means_spread_as_the_standard_error() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let scenes: Vec<f64> = (0..40).map(|_| normal_value(&mut rng)).collect();
        let row = |seed: f64, rng: &mut ChaCha8Rng| -> Vec<f64> {
            let cells = scenes.iter();
            cells
                .map(|scene| seed + scene + 0.05 * normal_value(rng))
                .collect()
        };
        let rows: Vec<Vec<f64>> = (0..40)
            .map(|_| row(0.5 * normal_value(&mut rng), &mut rng))
            .collect();
        let table = table(&rows);
        let found = Bootstrap::new(&table, RESAMPLES).expect("base scenes");
        let squares = found.means.iter().map(|mean| (mean - table.mean).powi(2));
        let deviation = (squares.sum::<f64>() / RESAMPLES as f64).sqrt();
        let ratio = deviation / found.standard_error();
        assert!((0.95..1.02).contains(&ratio), "{ratio}");
    }

    /// Values 0 and 1, with 1 in one of n: the skewness of the mean is (1 - 2 p) / sqrt(n p (1 - p)).
    #[test]
    fn the_acceleration_is_a_sixth_of_the_skewness() {
        let row: Vec<f64> = (0..10).map(|i| f64::from(u8::from(i == 0))).collect();
        let (n, p) = (10.0, 0.1);
        let expected = (1.0 - 2.0 * p) / f64::sqrt(n * p * (1.0 - p)) / 6.0;
        let found = acceleration(&table(&[row]));
        assert!((found - expected).abs() < 1e-12, "{found} {expected}");
    }

    #[test]
    fn an_interval_of_skewed_values_reaches_further_to_their_side() {
        let row: Vec<f64> = (0..60).map(|i| f64::from(u8::from(i % 15 == 0))).collect();
        let table = table(&[row]);
        let [low, high] = Bootstrap::new(&table, RESAMPLES)
            .expect("base scenes")
            .interval(0.05);
        let [below, above] = [table.mean - low, high - table.mean];
        assert!(above > 1.15 * below, "{below} {above}");
    }

    /// With two seeds the t value of one degree of freedom, 12.7, counts.
    #[test]
    fn two_seeds_that_disagree_give_a_wide_interval() {
        let table = table(&[vec![0.1; 20], vec![0.3; 20]]);
        let [low, high] = Bootstrap::new(&table, RESAMPLES)
            .expect("base scenes")
            .interval(0.05);
        let expected = 12.706 * 0.1;
        assert!((high - low - 2.0 * expected).abs() < 1e-3, "{low} {high}");
    }

    #[test]
    fn the_p_value_is_where_the_interval_reaches_zero() {
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let row: Vec<f64> = (0..20).map(|_| 0.4 + normal_value(&mut rng)).collect();
        let table = table(&[row]);
        let found = Bootstrap::new(&table, RESAMPLES).expect("base scenes");
        let p = found.p_value();
        assert!((0.001..0.5).contains(&p), "{p}");
        let lower_end = |outside: f64| found.interval(outside)[0];
        assert!(lower_end(1.01 * p) > 0.0 && lower_end(0.99 * p) <= 0.0);
    }
}
