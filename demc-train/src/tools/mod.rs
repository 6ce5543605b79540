//! Tools beside training: ablation, learning-rate finder, curves.

pub mod ablation;
pub mod chart;
pub mod find_lr;
pub mod plot;
