//! Tools beside training: ablation, learning-rate finder, curves, estimate of the duration.

pub mod ablation;
pub mod chart;
pub mod estimate;
pub mod find_lr;
pub mod plot;
