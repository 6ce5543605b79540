//! Counts of dormant channels ([`demc_model::dormant`]).

use demc_model::dormant::Dormant;

/// How many of a network's channels are dormant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Census {
    /// Those that have had no gradient for 175 steps.
    pub dormant: usize,
    /// All.
    pub channels: usize,
}

impl Census {
    /// Counts over all layers.
    pub fn of(layers: &Dormant) -> Self {
        let flags = || layers.values().flatten();
        Census {
            dormant: flags().filter(|dormant| **dormant).count(),
            channels: flags().count(),
        }
    }

    /// From 0 to 1.
    pub fn share(self) -> f64 {
        self.dormant as f64 / self.channels.max(1) as f64
    }
}
