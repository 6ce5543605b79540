//! The records of a run: `metrics.jsonl`, TensorBoard events, progress on the terminal.

pub mod metrics_log;
pub mod progress;
pub mod recorder;
pub mod tensorboard;
