//! Timing in turns (A B A B), so that a slower machine affects both alike.
//!
//! divan (last release 0.1.21) runs one bench after the other and reports no ratio of two. On a
//! shared machine, only that ratio is reliable.

use std::time::Instant;

/// Minimum duration of a turn, so that clock and turn changes are negligible.
const TURN_SECONDS: f64 = 0.02;

/// Seconds of each turn, in the order of the rounds.
#[derive(Clone, Debug, PartialEq)]
pub struct Turns(Vec<f64>);

/// Minimum, median and maximum of some values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// The minimum.
    pub min: f64,
    /// The median; of an even number of values, the upper one.
    pub median: f64,
    /// The maximum.
    pub max: f64,
}

impl Spread {
    /// The spread of some values.
    ///
    /// # Panics
    /// If there are no values.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Self {
        let mut sorted: Vec<f64> = values.into_iter().collect();
        sorted.sort_by(f64::total_cmp);
        Spread {
            min: sorted[0],
            median: sorted[sorted.len() / 2],
            max: sorted[sorted.len() - 1],
        }
    }
}

impl Turns {
    /// Spread of the turns in seconds.
    pub fn spread(&self) -> Spread {
        Spread::of(self.0.iter().copied())
    }

    /// Ratio of these times to those of `other`, round by round.
    pub fn ratio(&self, other: &Turns) -> Spread {
        Spread::of(self.0.iter().zip(&other.0).map(|(a, b)| a / b))
    }
}

/// Seconds per call of `run`, averaged over one turn.
pub fn turn(run: &mut dyn FnMut()) -> f64 {
    let started = Instant::now();
    let mut calls = 0;
    loop {
        run();
        calls += 1;
        let seconds = started.elapsed().as_secs_f64();
        if seconds >= TURN_SECONDS {
            return seconds / f64::from(calls);
        }
    }
}

/// Runs each once to warm up, then each in turn, `rounds` times.
pub fn interleaved<const N: usize>(rounds: usize, runs: [&mut dyn FnMut(); N]) -> [Turns; N] {
    let mut turns = [(); N].map(|()| Turns(Vec::with_capacity(rounds)));
    let mut runs = runs;
    for run in &mut runs {
        run();
    }
    for _ in 0..rounds {
        for (run, turns) in runs.iter_mut().zip(&mut turns) {
            turns.0.push(turn(run));
        }
    }
    turns
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_is_that_of_the_sorted_values() {
        let spread = Spread::of([3.0, 1.0, 2.0]);
        assert_eq!((spread.min, spread.median, spread.max), (1.0, 2.0, 3.0));
    }

    #[test]
    fn ratio_is_taken_round_by_round() {
        let ratio = Turns(vec![2.0, 40.0]).ratio(&Turns(vec![1.0, 10.0]));
        assert_eq!((ratio.min, ratio.max), (2.0, 4.0));
    }

    #[test]
    fn each_gets_its_turns() {
        let (mut a, mut b) = (0, 0);
        let turns = interleaved(3, [&mut || a += 1, &mut || b += 1]);
        assert!(turns.iter().all(|turns| turns.0.len() == 3));
        assert!(a > 3 && b > 3);
    }
}
