//! The statistics on simulated data, where the true difference is known.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::estimate::{Estimate, Scale, holm};
use super::paired::PairedDifferences;

/// Simulated experiments per case. The standard error of a share of 5 % is 1 %.
const EXPERIMENTS: usize = 450;
/// Resamples per interval; 1 in 40 of them lies beyond an end.
const RESAMPLES: usize = 400;

/// A normal value of variance 1: the sum of 12 uniform numbers.
pub(super) fn normal_value(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
}

/// A value of mean 0, variance 1, and skewness 2.
fn exponential_value(rng: &mut ChaCha8Rng) -> f64 {
    -(1.0 - rng.random::<f64>()).ln() - 1.0
}

pub(super) fn names(count: usize) -> Vec<String> {
    (0..count).map(|i| format!("scene {i}")).collect()
}

type Draw = fn(&mut ChaCha8Rng) -> f64;

/// A kind of experiment: sizes, and the deviations of the effects.
struct Experiment {
    seeds: usize,
    bases: usize,
    /// Deviations between seeds, between base scenes, and of single cells.
    deviations: [f64; 3],
    scenes: Draw,
}

impl Experiment {
    /// The result for a true difference of `effect`.
    fn estimate(&self, effect: f64, rng: &mut ChaCha8Rng) -> Estimate {
        let [of_seed, of_scene, of_cell] = self.deviations;
        let scenes: Vec<f64> = (0..self.bases)
            .map(|_| of_scene * (self.scenes)(rng))
            .collect();
        let row = |_| -> Vec<f64> {
            let seed = effect + of_seed * normal_value(rng);
            let cells = scenes.iter();
            cells
                .map(|scene| seed + scene + of_cell * normal_value(rng))
                .collect()
        };
        let rows: Vec<Vec<f64>> = (0..self.seeds).map(row).collect();
        let names = names(self.bases);
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let table = PairedDifferences::new(&rows, &names).expect("cells");
        Estimate::of(&table, Scale::Difference, self.bases, RESAMPLES).expect("base scenes")
    }

    fn estimates(&self, effect: f64) -> Vec<Estimate> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seeds as u64 * 100 + self.bases as u64);
        (0..EXPERIMENTS)
            .map(|_| self.estimate(effect, &mut rng))
            .collect()
    }
}

fn share(estimates: &[Estimate], holds: impl Fn(&Estimate) -> bool) -> f64 {
    let count = estimates.iter().filter(|estimate| holds(estimate)).count();
    count as f64 / estimates.len() as f64
}

/// Experiments of 13 base scenes, as in `results/renders`: where mainly scenes differ, or seeds.
const EXPERIMENTS_OF: [(&str, [f64; 3]); 2] =
    [("scenes", [0.03, 0.1, 0.05]), ("seeds", [0.1, 0.02, 0.02])];

fn experiments(seeds: usize) -> impl Iterator<Item = (String, Experiment)> {
    let kinds: [(&str, Draw); 2] = [("normal", normal_value), ("skewed", exponential_value)];
    let pairs = kinds
        .into_iter()
        .flat_map(|kind| EXPERIMENTS_OF.map(|differing| (kind, differing)));
    pairs.map(move |((kind, scenes), (differing, deviations))| {
        let name = format!("{seeds} seeds, {kind} scenes, {differing} differ");
        let experiment = Experiment {
            seeds,
            bases: 13,
            deviations,
            scenes,
        };
        (name, experiment)
    })
}

fn covers_zero(found: &Estimate) -> bool {
    let [low, high] = found.interval;
    low <= 0.0 && high >= 0.0
}

/// Without a true difference, intervals cover it in 93 to 99 % of the experiments, and at most 5 %
/// of them, plus two standard errors, claim one.
fn check(seeds: usize) {
    for (name, experiment) in experiments(seeds) {
        let estimates = experiment.estimates(0.0);
        let covering = share(&estimates, covers_zero);
        assert!((0.93..=0.99).contains(&covering), "{name}: {covering}");
        let claimed = share(&estimates, Estimate::is_claimed);
        assert!(claimed <= 0.07, "{name}: {claimed}");
    }
}

#[test]
fn intervals_over_two_seeds_cover_and_false_claims_are_rare() {
    check(2);
}

#[test]
fn intervals_over_three_seeds_cover_and_false_claims_are_rare() {
    check(3);
}

#[test]
fn intervals_over_five_seeds_cover_and_false_claims_are_rare() {
    check(5);
}

/// One seed: the interval is for this seed, so its effect is part of the true mean.
#[test]
fn intervals_of_one_seed_cover_the_mean_over_scenes() {
    for scenes in [normal_value as Draw, exponential_value] {
        let experiment = Experiment {
            seeds: 1,
            bases: 13,
            deviations: [0.0, 0.1, 0.05],
            scenes,
        };
        let estimates = experiment.estimates(0.0);
        let covering = share(&estimates, covers_zero);
        assert!((0.92..=0.98).contains(&covering), "{covering}");
        assert!(share(&estimates, Estimate::is_claimed) <= 0.07);
    }
}

/// Three comparisons in one table: after Holm's correction, at most 5 % of the tables have a wrong
/// claim. Without it, about three times as many have one.
#[test]
fn few_tables_have_a_false_claim() {
    let experiment = Experiment {
        seeds: 5,
        bases: 13,
        deviations: [0.1, 0.02, 0.02],
        scenes: normal_value,
    };
    let mut tables = experiment.estimates(0.0);
    let has_claim = |table: &&mut [Estimate]| table.iter().any(Estimate::is_claimed);
    let before = tables.chunks_exact_mut(3).filter(|t| has_claim(t)).count();
    for table in tables.chunks_exact_mut(3) {
        holm(table);
    }
    let after = tables.chunks_exact_mut(3).filter(|t| has_claim(t)).count();
    let count = (EXPERIMENTS / 3) as f64;
    assert!(before as f64 / count > 0.09, "{before}");
    assert!(
        after as f64 / count <= 0.05 + 2.0 * (0.05 * 0.95 / count).sqrt(),
        "{after}"
    );
}

/// A true difference as large as the mean smallest detectable one is found in about 80 % of the
/// experiments.
#[test]
fn the_detectable_difference_is_found_in_four_of_five_experiments() {
    for (name, experiment) in experiments(5) {
        let without = experiment.estimates(0.0);
        let detectable = without.iter().map(|found| found.detectable).sum::<f64>();
        let found = experiment.estimates(detectable / without.len() as f64);
        let power = share(&found, Estimate::is_claimed);
        assert!((0.7..=0.95).contains(&power), "{name}: {power}");
        assert!(share(&found, |found| found.mean > 0.0) > 0.95);
    }
}
