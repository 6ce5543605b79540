//! The learning rate as a function of the step (Sec. 4.2: from 1e-4 to 5e-6).

use serde::{Deserialize, Serialize};

/// Curve of the learning rate from its start to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LrDecay {
    /// The same factor each step. Ours: the paper gives the range only.
    Exponential,
    /// Half a cosine.
    Cosine,
}

/// The learning rate over a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRate {
    /// Rate of step 0.
    pub start: f64,
    /// Rate of step `steps`.
    pub end: f64,
    /// Curve between them.
    pub decay: LrDecay,
    /// Steps of the run.
    pub steps: u64,
    /// Steps at the beginning over which the rate rises linearly to the curve.
    pub warmup_steps: u64,
}

impl LearningRate {
    /// The rate of step `step`, counted from 0.
    pub fn at(&self, step: u64) -> f64 {
        let Self { start, end, .. } = *self;
        let done = step as f64 / self.steps as f64;
        let warmup = match self.warmup_steps {
            0 => 1.0,
            steps => f64::min(1.0, (step + 1) as f64 / steps as f64),
        };
        warmup
            * match self.decay {
                LrDecay::Exponential => start * (end / start).powf(done),
                LrDecay::Cosine => {
                    end + (start - end) * 0.5 * (1.0 + (std::f64::consts::PI * done).cos())
                }
            }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rate(decay: LrDecay) -> LearningRate {
        LearningRate {
            start: 1e-4,
            end: 5e-6,
            decay,
            steps: 1000,
            warmup_steps: 0,
        }
    }

    #[test]
    fn warmup_rises_linearly_to_the_curve() {
        let plain = rate(LrDecay::Cosine);
        let warm = LearningRate {
            warmup_steps: 100,
            ..plain
        };
        assert_eq!(warm.at(0), 0.01 * plain.at(0));
        assert!((0..99).all(|step| warm.at(step) < warm.at(step + 1)));
        assert!((99..1000).all(|step| warm.at(step) == plain.at(step)));
    }

    #[test]
    fn every_decay_starts_at_the_start() {
        for decay in [LrDecay::Exponential, LrDecay::Cosine] {
            assert_eq!(rate(decay).at(0), 1e-4);
        }
    }

    #[test]
    fn every_decay_falls_to_the_end() {
        for decay in [LrDecay::Exponential, LrDecay::Cosine] {
            let rate = rate(decay);
            assert!((rate.at(1000) - 5e-6).abs() < 1e-18);
            assert!((0..1000).all(|step| rate.at(step + 1) < rate.at(step)));
        }
    }

    #[test]
    fn exponential_decay_passes_the_geometric_mean_half_way() {
        assert!((rate(LrDecay::Exponential).at(500) - (1e-4f64 * 5e-6).sqrt()).abs() < 1e-18);
    }
}
