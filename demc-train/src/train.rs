//! The training loop.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_data::{BatchLoader, PatchSource};
use demc_infer::bundle::locate::BEST;
use demc_infer::bundle::{Bundle, BundleFile, BundleMeta, Names, Precision};
use demc_infer::evaluate::Report;

use crate::checkpoint::{self, Best, Checkpoint, Means, State};
use crate::config::Config;
use crate::data::Data;
use crate::metrics_log::Line;
use crate::optimizer::Adam;
use crate::progress::{Progress, say};
use crate::run_dir::{Facts, RunDir};
use crate::trainer::{Step, Trainer, initial_model};
use crate::validation;

/// A run that is ready to go.
pub struct Run {
    config: Config,
    data: Data,
    dir: RunDir,
    source: Arc<PatchSource>,
    trainer: Trainer,
    state: State,
}

impl Run {
    /// A new run, or the one of `checkpoint` where it stopped. `device` is plain.
    ///
    /// # Errors
    /// Scenes smaller than a patch; a checkpoint that is not of this run.
    pub fn new(
        config: Config,
        data: Data,
        dir: RunDir,
        checkpoint: Option<Checkpoint>,
        device: &Device,
    ) -> anyhow::Result<Self> {
        let device = device.clone().autodiff();
        let source = PatchSource::new(
            &config.data,
            data.train.clone(),
            data.layout.clone(),
            data.normalizer.clone(),
            config.train.seed,
        )?;
        let (model, adam, state) = match checkpoint {
            Some(Checkpoint {
                bundle,
                adam,
                state,
            }) => {
                let (normalizer, layout) = (data.normalizer.clone(), data.layout.clone());
                let expected = BundleMeta::new(config.model, normalizer, layout, state.step);
                ensure!(
                    bundle.meta == expected,
                    "{}: the checkpoint has another network, layout or statistics than this run",
                    dir.path().display()
                );
                if state.best.is_some() {
                    // Now, not when the last step is done.
                    BundleFile::read(&dir.path().join(BEST))?;
                }
                (bundle.model, adam, state)
            }
            None => {
                let model = initial_model(
                    &config.model,
                    config.train.seed,
                    data.normalizer.flat_color,
                    &device,
                );
                (model, Adam::new(config.train.adam_epsilon), State::start())
            }
        };
        let trainer = Trainer::new(&config, model, adam, device);
        Ok(Run {
            config,
            data,
            dir,
            source: Arc::new(source),
            trainer,
            state,
        })
    }

    /// Patches that one step sees.
    pub fn patches_per_step(&self) -> u64 {
        self.config.patches_per_step()
    }

    /// Patches of an epoch.
    pub fn patches(&self) -> usize {
        self.source.patches().len()
    }

    /// Trainable values of the network.
    pub fn parameters(&self) -> usize {
        self.trainer.model().parameter_count()
    }

    /// Trains to the last step, recording on the way; `device` is the device's name, for the record.
    ///
    /// # Errors
    /// A scene that cannot be read, a file that cannot be written, a loss that is not finite.
    pub fn train(&mut self, device: &str) -> anyhow::Result<()> {
        let facts = Facts {
            device,
            operations: &self.trainer.operations(),
            parameters: self.parameters(),
            patches: self.patches(),
        };
        if let Some(note) = self.dir.open(&self.config, &self.data, facts)? {
            say(format!("note: {note}"));
        }
        let (train, run) = (self.config.train.clone(), self.config.run.clone());
        let rate = self.config.learning_rate();
        let first_batch = self.state.step * train.grad_accumulation as u64;
        let mut loader = BatchLoader::new(self.source.clone(), first_batch);
        let mut metrics = self.dir.metrics(self.state.step)?;
        let progress = Progress::new(
            self.state.step,
            train.steps,
            self.config.patches_per_step(),
            self.patches(),
        );
        let (started, before) = (Instant::now(), self.state.elapsed_s);
        while self.state.step < train.steps {
            let lr = rate.at(self.state.step);
            let step = self.trainer.step(lr, || loader.next())?;
            self.count(step, lr)?;
            let at = self.state.step;
            progress.step(at, step.loss);
            self.state.elapsed_s = before + started.elapsed().as_secs_f64();
            let due = |every: u64| at.is_multiple_of(every) || at == train.steps;
            let scores = if due(run.validate_every) {
                self.validate()?
            } else {
                None
            };
            if due(run.log_every) || scores.is_some() {
                let line = self.line(lr, scores.as_ref());
                metrics.append(&line)?;
                self.state.since_log = Means::default();
                progress.line(self.describe(&line));
            }
            if due(run.checkpoint_every) {
                checkpoint::save(
                    self.dir.path(),
                    &self.bundle(),
                    self.trainer.adam(),
                    &self.state,
                    run.keep,
                )?;
            }
        }
        progress.finish();
        Ok(())
    }

    /// Takes a step into the state.
    fn count(&mut self, step: Step, lr: f64) -> anyhow::Result<()> {
        self.state.step += 1;
        ensure!(
            step.loss.is_finite() && step.grad_norm.is_finite(),
            "step {}: loss {} and gradient norm {} at learning rate {lr:.3e}: not finite; the last checkpoint is good",
            self.state.step,
            step.loss,
            step.grad_norm
        );
        let means = &mut self.state.since_log;
        means.steps += 1;
        means.loss += step.loss;
        means.grad_norm += step.grad_norm;
        Ok(())
    }

    /// Scores the validation scenes, draws them, and keeps the weights if they are the best so far.
    fn validate(&mut self) -> anyhow::Result<Option<Report>> {
        if self.data.validation.is_empty() {
            return Ok(None);
        }
        let bundle = self.bundle();
        let (report, picture) =
            validation::score(&bundle, &self.data.validation, validation::STRIP_SCENES)
                .context("validation")?;
        let step = self.state.step;
        if let Some(picture) = picture {
            validation::write_strip(self.dir.path(), &format!("step-{step:08}.png"), &picture)?;
        }
        let relmse = report.mean.denoised.relmse;
        if self.state.best.is_none_or(|best| relmse < best.relmse) {
            bundle.save(&self.dir.path().join(BEST), Names::Burn, Precision::F32)?;
            self.state.best = Some(Best { step, relmse });
        }
        Ok(Some(report))
    }

    fn line(&self, lr: f64, scores: Option<&Report>) -> Line {
        let Means {
            steps,
            loss,
            grad_norm,
        } = self.state.since_log;
        let denoised = scores.map(|report| report.mean.denoised);
        Line {
            step: self.state.step,
            epoch: (self.state.step * self.config.patches_per_step()) as f64
                / self.patches() as f64,
            loss: loss / steps as f64,
            lr,
            grad_norm: grad_norm / steps as f64,
            valid_relmse: denoised.map(|score| score.relmse),
            valid_ssim: denoised.and_then(|score| score.ssim),
            elapsed_s: self.state.elapsed_s,
        }
    }

    fn describe(&self, line: &Line) -> String {
        let Line { step, loss, lr, .. } = line;
        let mut text = format!("step {step:>6}  loss {loss:.4}  lr {lr:.2e}");
        if let (Some(relmse), Some(ssim)) = (line.valid_relmse, line.valid_ssim) {
            text += &format!("  validation RelMSE {relmse:.4}  SSIM {ssim:.4}");
        }
        if self.state.best.is_some_and(|best| best.step == *step) {
            text += "  best";
        }
        text
    }

    /// The network as it stands, on the plain device, with all that belongs to it.
    fn bundle(&self) -> Bundle {
        use burn::module::Module;
        let meta = BundleMeta::new(
            self.config.model,
            self.data.normalizer.clone(),
            self.data.layout.clone(),
            self.state.step,
        );
        Bundle {
            meta,
            model: self.trainer.model().valid(),
        }
    }

    /// Scores the test split with the best weights (the last ones where nothing was validated); `None` without one.
    /// Writes `test.json` and `strips/test.png`.
    ///
    /// # Errors
    /// A scene that cannot be read, a file that cannot be written.
    pub fn test(&self, device: &Device) -> anyhow::Result<Option<(u64, Report)>> {
        if self.data.test.is_empty() {
            return Ok(None);
        }
        let best = self.dir.path().join(BEST);
        let bundle = match self.state.best {
            Some(_) => Bundle::load(&best, device)?,
            None => self.bundle(),
        };
        let (report, picture) =
            validation::score(&bundle, &self.data.test, usize::MAX).context("test")?;
        if let Some(picture) = picture {
            validation::write_strip(self.dir.path(), "test.png", &picture)?;
        }
        self.dir
            .write("test.json", &serde_json::to_vec_pretty(&report)?)?;
        Ok(Some((bundle.meta.step, report)))
    }
}
