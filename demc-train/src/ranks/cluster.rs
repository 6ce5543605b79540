//! The predicted time of a step on a cluster.

use std::fmt;

use demc_program::message::duration;

/// Seconds per message between two nodes. Ours: measured over TCP by benches/scaling.py.
const LATENCY: f64 = 5e-5;

/// A model of a step on a cluster, with one rank per node like this computer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClusterEstimate {
    /// Ranks.
    pub ranks: usize,
    /// Seconds of forward and backward pass.
    pub compute: f64,
    /// Seconds of the exchange.
    pub exchange: f64,
    /// Bytes that each rank sends.
    pub bytes: f64,
}

impl ClusterEstimate {
    /// The model for a rank that takes `compute` seconds for its share of a step, a gradient of `floats`
    /// values, and a network of `bandwidth` bytes per second.
    ///
    /// Each rank sends a slice of its gradient to each other rank, and then the sum of its own slice.
    pub fn new(compute: f64, floats: u64, ranks: usize, bandwidth: f64) -> Self {
        let others = (ranks - 1) as f64;
        let bytes = 2.0 * others / ranks as f64 * (floats * 4) as f64;
        ClusterEstimate {
            ranks,
            compute,
            exchange: 2.0 * others * LATENCY + bytes / bandwidth,
            bytes,
        }
    }

    /// Seconds of a step.
    pub fn step(&self) -> f64 {
        self.compute + self.exchange
    }
}

impl fmt::Display for ClusterEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "model of {} ranks, one per node like this one: {} per step, {:.0} % of it exchange; each rank sends {:.1} MB",
            self.ranks,
            duration(self.step()),
            100.0 * self.exchange / self.step(),
            self.bytes / 1e6
        )
    }
}
