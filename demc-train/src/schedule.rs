//! The learning rate as a function of the step (Sec. 4.2: from 1e-4 to 5e-6).

use serde::{Deserialize, Serialize};

/// How the learning rate goes from its start to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Decay {
    /// By the same factor each step; ours, the paper gives the range only.
    Exponential,
    /// Along half a cosine.
    Cosine,
    /// By the same amount each step.
    Linear,
    /// Not at all: the start's value throughout.
    Constant,
}

/// A learning rate over a run of `steps`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRate {
    /// At step 0.
    pub start: f64,
    /// Where step `steps` would be.
    pub end: f64,
    /// The way between.
    pub decay: Decay,
    /// Steps of the run.
    pub steps: u64,
    /// Steps at the beginning over which the rate climbs to what it would be without them; 0: none.
    pub warmup: u64,
}

impl LearningRate {
    /// The rate of step `step`, counted from 0.
    pub fn at(&self, step: u64) -> f64 {
        let Self { start, end, .. } = *self;
        let done = step as f64 / self.steps as f64;
        let climbed = match self.warmup {
            0 => 1.0,
            warmup => f64::min(1.0, (step + 1) as f64 / warmup as f64),
        };
        climbed
            * match self.decay {
                Decay::Exponential => start * (end / start).powf(done),
                Decay::Cosine => {
                    end + (start - end) * 0.5 * (1.0 + (std::f64::consts::PI * done).cos())
                }
                Decay::Linear => start + (end - start) * done,
                Decay::Constant => start,
            }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rate(decay: Decay) -> LearningRate {
        LearningRate {
            start: 1e-4,
            end: 5e-6,
            decay,
            steps: 1000,
            warmup: 0,
        }
    }

    #[test]
    fn a_warm_rate_climbs_evenly_and_is_then_as_without() {
        let plain = rate(Decay::Cosine);
        let warm = LearningRate {
            warmup: 100,
            ..plain
        };
        assert_eq!(warm.at(0), 0.01 * plain.at(0));
        assert!((0..99).all(|step| warm.at(step) < warm.at(step + 1)));
        assert!((99..1000).all(|step| warm.at(step) == plain.at(step)));
    }

    #[test]
    fn every_decay_starts_at_the_start() {
        for decay in [
            Decay::Exponential,
            Decay::Cosine,
            Decay::Linear,
            Decay::Constant,
        ] {
            assert_eq!(rate(decay).at(0), 1e-4);
        }
    }

    #[test]
    fn every_decay_but_the_constant_falls_to_the_end() {
        for decay in [Decay::Exponential, Decay::Cosine, Decay::Linear] {
            let rate = rate(decay);
            assert!((rate.at(1000) - 5e-6).abs() < 1e-18);
            assert!((0..1000).all(|step| rate.at(step + 1) < rate.at(step)));
        }
        assert_eq!(rate(Decay::Constant).at(1000), 1e-4);
    }

    #[test]
    fn exponential_is_at_the_geometric_mean_half_way() {
        assert!((rate(Decay::Exponential).at(500) - (1e-4f64 * 5e-6).sqrt()).abs() < 1e-18);
    }
}
