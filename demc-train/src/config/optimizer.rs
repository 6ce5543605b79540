//! The table `[optimizer]`.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};

use super::learning_rate::LrDecay;
use super::problems::{MAX_STEPS, TableProblems};

/// First learning rate (Sec. 4.2).
const LR_START: f64 = 1e-4;
/// Last learning rate (Sec. 4.2).
const LR_END: f64 = 5e-6;
/// Learning rates. Ours: those of trainings are from 1e-7 to 0.1, and others end in NaN.
const RATES: RangeInclusive<f64> = 1e-30..=10.0;
/// Largest weight decay. Ours: at learning rates up to 0.1 it never removes more than a kernel.
const MAX_DECAY: f64 = 10.0;
/// Largest matrix for Muon, in rows. Ours: every kernel of the level widths that this project
/// trains.
const MUON_MAX_ROWS: usize = 128;

/// Which optimizer updates the kernels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OptimizerKind {
    /// Adam for every weight, as in the paper (Kingma and Ba 2014).
    #[default]
    Adam,
    /// Muon for kernels, except the head; Adam for all other weights (Jordan et al. 2024).
    Muon,
}

/// The `[optimizer]` table.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizerConfig {
    /// Adam or Muon.
    pub kind: OptimizerKind,
    /// Muon updates matrices with at most this many rows, Adam the larger ones; only with `kind =
    /// "muon"`. Rows are the output channels of a kernel. Absent: 128.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub muon_max_rows: Option<usize>,
    /// Share of every kernel that a step at learning rate 1 removes (decoupled weight decay,
    /// Loshchilov and Hutter 2019). Paper: none.
    pub weight_decay: f64,
    /// Factor of the learning rate for the U-Net's own weights, beside those of a second encoder.
    /// Paper: none.
    pub trunk_rate: f64,
    /// Learning rate of the first step.
    pub lr_start: f64,
    /// Learning rate at the end of the run.
    pub lr_end: f64,
    /// Curve from `lr_start` to `lr_end`.
    pub lr_decay: LrDecay,
    /// Steps at the beginning over which the learning rate rises linearly. Paper: none.
    pub warmup_steps: u64,
    /// Largest norm of the whole gradient; a longer gradient is scaled down. Absent: no clipping,
    /// as in the paper.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_grad_norm: Option<f32>,
}

impl Default for OptimizerConfig {
    /// The paper's optimizer (Sec. 4.2).
    fn default() -> Self {
        OptimizerConfig {
            kind: OptimizerKind::Adam,
            muon_max_rows: None,
            weight_decay: 0.0,
            trunk_rate: 1.0,
            lr_start: LR_START,
            lr_end: LR_END,
            lr_decay: LrDecay::Exponential,
            warmup_steps: 0,
            max_grad_norm: None,
        }
    }
}

impl OptimizerConfig {
    /// Every value out of range, one line each.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = TableProblems::of("optimizer");
        let (least, most) = RATES.into_inner();
        for (key, value) in [("lr_start", self.lr_start), ("lr_end", self.lr_end)] {
            let allowed = format!("from {least:e} to {most}");
            problems.require(RATES.contains(&value), key, &value, &allowed);
        }
        let decay = self.weight_decay;
        problems.require(
            (0.0..=MAX_DECAY).contains(&decay),
            "weight_decay",
            &decay,
            &format!("from 0 to {MAX_DECAY}"),
        );
        problems.require(
            (0.0..=1.0).contains(&self.trunk_rate),
            "trunk_rate",
            &self.trunk_rate,
            "from 0 to 1",
        );
        if let Some(norm) = self.max_grad_norm {
            let holds = norm.is_finite() && norm > 0.0;
            let allowed = "a positive number, or absent for no clipping";
            problems.require(holds, "max_grad_norm", &norm, allowed);
        }
        if let Some(rows) = self.muon_max_rows {
            problems.require(rows > 0, "muon_max_rows", &rows, "at least 1");
            problems.require(
                self.kind == OptimizerKind::Muon,
                "muon_max_rows",
                &rows,
                "absent unless optimizer.kind = \"muon\"; --set optimizer.muon_max_rows= removes it",
            );
        }
        problems.require(
            self.warmup_steps <= MAX_STEPS,
            "warmup_steps",
            &self.warmup_steps,
            &format!("at most {MAX_STEPS}"),
        );
        problems.into_lines()
    }

    pub(super) fn resolve(&mut self) {
        self.muon_max_rows = self.muon_rows();
    }

    /// Rows up to which Muon updates a matrix; `None` with Adam alone.
    pub fn muon_rows(&self) -> Option<usize> {
        match self.kind {
            OptimizerKind::Adam => None,
            OptimizerKind::Muon => Some(self.muon_max_rows.unwrap_or(MUON_MAX_ROWS)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn muon_rows_need_muon() {
        let mut config = OptimizerConfig {
            muon_max_rows: Some(64),
            ..OptimizerConfig::default()
        };
        let problems = config.validate();
        assert_eq!(problems.len(), 1, "{problems:?}");
        assert!(
            problems[0].starts_with("optimizer.muon_max_rows = 64: must be absent unless"),
            "{problems:?}"
        );
        config.kind = OptimizerKind::Muon;
        assert_eq!(config.validate(), [""; 0]);
        assert_eq!(config.muon_rows(), Some(64));
        config.muon_max_rows = None;
        assert_eq!(config.muon_rows(), Some(128));
    }

    #[test]
    fn learning_rates_that_only_give_nan_are_refused() {
        for rate in [0.0, 5e-324, 1e-300, 525_600.0, 1e300, f64::NAN] {
            let config = OptimizerConfig {
                lr_start: rate,
                lr_end: rate,
                ..OptimizerConfig::default()
            };
            let problems = config.validate();
            assert_eq!(problems.len(), 2, "{problems:?}");
            let expected = format!("optimizer.lr_start = {rate:?}: must be from 1e-30 to 10");
            assert_eq!(problems[0], expected);
        }
    }

    #[test]
    fn zero_switches_nothing_off() {
        let config = OptimizerConfig {
            kind: OptimizerKind::Muon,
            muon_max_rows: Some(0),
            max_grad_norm: Some(0.0),
            ..OptimizerConfig::default()
        };
        assert_eq!(config.validate().len(), 2, "{:?}", config.validate());
    }
}
