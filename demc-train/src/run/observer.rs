//! What a program that trains in its own process hears of every step.

use crate::run::validation::Validation;
use crate::step::trainer::StepReport;

/// A step that was taken or skipped.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct TakenStep {
    /// Its number, from 1.
    pub step: u64,
    /// Number of steps of the run.
    pub steps: u64,
    /// Loss before the step, mean over its patches; NaN for a skipped step.
    pub loss: f64,
    /// Norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Learning rate.
    pub lr: f64,
    /// RelMSE of the validation after this step, if there was one.
    pub valid_relmse: Option<f64>,
    /// SSIM of that validation.
    pub valid_ssim: Option<f64>,
}

impl TakenStep {
    pub(crate) fn new(
        [step, steps]: [u64; 2],
        report: &StepReport,
        lr: f64,
        validation: Option<&Validation>,
    ) -> Self {
        let denoised = validation.map(|found| &found.report.mean.denoised);
        Self {
            step,
            steps,
            loss: report.loss,
            grad_norm: report.grad_norm,
            lr,
            valid_relmse: denoised.map(|score| score.relmse),
            valid_ssim: denoised.and_then(|score| score.ssim),
        }
    }
}
