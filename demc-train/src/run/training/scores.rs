//! Scores of a run: on the validation scenes during the training, on the test scenes after it.

use anyhow::Context;
use burn::tensor::Device;
use demc_infer::bundle::locate::BEST;
use demc_infer::bundle::{Bundle, Names, Precision};
use demc_infer::evaluate::Report;

use super::TrainingRun;
use crate::record::recorder::{Recorder, write_strip};
use crate::run::checkpoint::BestValidation;
use crate::run::run_dir::SCORES;
use crate::run::validation::{self, Validation};

/// Scores of the test split.
#[derive(Clone, Debug)]
pub struct TestScores {
    /// The step of the weights.
    pub step: u64,
    /// The scores.
    pub report: Report,
}

impl TrainingRun {
    /// Scores and draws the validation scenes, and keeps the weights if they are the best so far.
    pub(super) fn validate(
        &mut self,
        recorder: &mut Recorder,
    ) -> anyhow::Result<Option<Validation>> {
        if self.data.validation.is_empty() || self.is_untrained() {
            return Ok(None);
        }
        let bundle = self.bundle(self.trainer.result());
        let strips = validation::STRIP_SCENES;
        let found = validation::score(&bundle, &self.data.validation, strips, &self.reduce)
            .context("validation")?;
        let step = self.state.step;
        if let Some(picture) = &found.picture {
            recorder.picture(step, picture)?;
        }
        let relmse = found.report.mean.denoised.relmse;
        if self.state.best.is_none_or(|best| relmse < best.relmse) {
            if self.reduce.is_first() {
                bundle.save(&self.dir.path().join(BEST), Names::Burn, Precision::F32)?;
            }
            self.state.best = Some(BestValidation { step, relmse });
        }
        Ok(Some(found))
    }

    /// Scores the test split with the kept weights; `None` without test scenes. Writes `test.json`
    /// and `strips/test.png`.
    ///
    /// # Errors
    /// A scene that cannot be read; a file that cannot be written.
    pub fn test(&self, device: &Device) -> anyhow::Result<Option<TestScores>> {
        if self.data.test.is_empty() {
            return Ok(None);
        }
        let bundle = match self.state.best {
            Some(_) => Bundle::load(&self.dir.path().join(BEST), device)?,
            None => self.bundle(self.trainer.result()),
        };
        let Validation {
            report, picture, ..
        } = validation::score(&bundle, &self.data.test, usize::MAX, &self.reduce)
            .context("test")?;
        if self.reduce.is_first() {
            if let Some(picture) = picture {
                write_strip(self.dir.path(), "test.png", &picture)?;
            }
            self.dir
                .write(SCORES, &serde_json::to_vec_pretty(&report)?)?;
        }
        Ok(Some(TestScores {
            step: bundle.meta.step,
            report,
        }))
    }
}
