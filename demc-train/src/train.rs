//! The training loop.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, bail, ensure};
use burn::module::Module;
use burn::tensor::Device;
use demc_data::{BatchLoader, PatchSource};
use demc_infer::bundle::locate::BEST;
use demc_infer::bundle::{Bundle, Names, Precision};
use demc_infer::evaluate::Report;
use demc_model::Denoiser;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::census::Census;
use crate::checkpoint::{self, Best, Checkpoint, Keep, Means, State, Store};
use crate::clock::Clock;
use crate::config::{Config, OnNan};
use crate::data::Data;
use crate::faults::patches_of;
use crate::initial::{Initial, Origin, initial_model};
use crate::metrics_log::Line;
use crate::optimizer::Optimizer;
use crate::recorder::{Recorder, timed};
use crate::run_dir::{Facts, RunDir};
use crate::signals::Signals;
use crate::trainer::{Step, Trainer};
use crate::validation::{self, Validation};
use crate::watch::Setting;

/// So many steps in a row that are not finite are the end of a run that skips them; ours.
const MOST_SKIPPED: u64 = 100;

/// A run that is ready to go.
pub struct Run {
    config: Config,
    data: Data,
    dir: RunDir,
    source: Arc<PatchSource>,
    trainer: Trainer,
    state: State,
    /// The network that it begins with, where that was trained before and the run is new.
    pub origin: Option<Origin>,
    /// Steps since one was taken.
    skipped_in_a_row: u64,
}

/// How a training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// With its last step.
    Done,
    /// Because of a signal, after a checkpoint of this step.
    Stopped {
        /// The signal.
        signal: i32,
        /// The step.
        step: u64,
    },
}

impl Run {
    /// A new run, or the one of `checkpoint` where it stopped. `device` is plain.
    ///
    /// # Errors
    /// Scenes smaller than a patch; a checkpoint that is not of this run; a `train.init` that does not fit.
    pub fn new(
        config: Config,
        mut data: Data,
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
        let (model, average, optimizer, state, origin) = match checkpoint {
            Some(Checkpoint {
                bundle,
                average,
                optimizer,
                state,
            }) => {
                if let Some(ranges) = &bundle.meta.ranges {
                    data.ranges = ranges.clone();
                }
                let expected = data.meta(config.model, state.step);
                ensure!(
                    bundle.meta == expected,
                    "{}: the checkpoint has another network, layout or statistics than this run",
                    dir.path().display()
                );
                ensure!(
                    average.is_some() == (config.train.ema > 0.0),
                    "{}: the checkpoint and train.ema do not agree on whether there is an average",
                    dir.path().display()
                );
                (bundle.model, average, optimizer, state, None)
            }
            None => {
                let Initial { model, origin } =
                    initial_model(&config, data.normalizer.flat_color, &device)?;
                if let Some(before) = origin.as_ref().and_then(|origin| origin.ranges.as_ref()) {
                    data.ranges = data.ranges.with(before);
                }
                let optimizer = Optimizer::new(&config.train);
                (model, None, optimizer, State::start(), origin)
            }
        };
        let trainer = Trainer::new(&config, model, optimizer, average, device);
        Ok(Run {
            config,
            data,
            dir,
            source: Arc::new(source),
            trainer,
            state,
            origin,
            skipped_in_a_row: 0,
        })
    }

    /// What the run is.
    pub fn config(&self) -> &Config {
        &self.config
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
    pub fn parameters(&self) -> u64 {
        self.config.model.parameter_count()
    }

    /// Trains to the last step or the first signal, recording on the way; `device` is the device's name, for the record.
    ///
    /// # Errors
    /// A scene that cannot be read, a file that cannot be written, a loss that is not finite.
    pub fn train(&mut self, device: &str) -> anyhow::Result<Ended> {
        let facts = Facts {
            device,
            operations: &self.trainer.operations(),
            parameters: self.parameters(),
            patches: self.patches(),
            origin: self.origin.as_ref(),
        };
        let note = self.dir.open(&self.config, &self.data, facts)?;
        let mut recorder =
            Recorder::open(&self.dir, &self.config, self.state.step, self.patches())?;
        if let Some(note) = note {
            recorder.say(&format!("note: {note}"));
        }
        let (train, run) = (self.config.train.clone(), self.config.run.clone());
        let rate = self.config.learning_rate();
        let names: Vec<String> = self
            .data
            .train
            .iter()
            .map(|scene| scene.name.clone())
            .collect();
        let first_batch = self.state.step * train.grad_accumulation as u64;
        let mut loader = BatchLoader::new(self.source.clone(), first_batch);
        let signals = Signals::listen()?;
        let mut clock = Clock::new(self.state.elapsed_s);
        while self.state.step < train.steps {
            let lr = rate.at(self.state.step);
            let (step, time) = timed(|| self.trainer.step(lr, || loader.next()));
            let step = step?;
            let mut warnings = self.count(&step, lr, &names)?;
            let at = self.state.step;
            recorder.step(at, step.loss, time);
            self.state.elapsed_s = clock.elapsed();
            let due = |every: u64| at.is_multiple_of(every) || at == train.steps;
            let mut validation = None;
            if due(run.validate_every) {
                validation = self.validate(&mut recorder)?;
            }
            if let Some(validation) = &validation {
                warnings.extend(self.state.watch.validation(&validation.health));
            }
            if due(run.log_every) || validation.is_some() {
                let line = self.line(lr, validation.as_ref());
                let watch = &mut self.state.watch;
                warnings.extend(line.dormant.and_then(|share| watch.dormant(share)));
                recorder.line(line, &self.describe(&line))?;
                self.state.since_log = Means::default();
            }
            for warning in warnings {
                recorder.say(&format!("warning: step {at}: {warning}"));
            }
            if at.is_multiple_of(train.recycle) && at < train.steps {
                self.recycle(&mut recorder);
            }
            let signal = signals.came();
            if due(run.checkpoint_every) || clock.is_due(&run) || signal.is_some() {
                self.save()?;
                clock.saved();
            }
            if let Some(signal) = signal.filter(|_| at < train.steps) {
                recorder.finish();
                return Ok(Ended::Stopped { signal, step: at });
            }
        }
        recorder.finish();
        Ok(Ended::Done)
    }

    /// Takes a step into the state; returns what the user should know.
    fn count(&mut self, step: &Step, lr: f64, names: &[String]) -> anyhow::Result<Vec<String>> {
        self.state.step += 1;
        if !step.is_finite() {
            self.skipped_in_a_row += 1;
            let skip = self.config.train.on_nan == OnNan::Skip;
            if !skip || self.skipped_in_a_row >= MOST_SKIPPED {
                bail!(self.not_finite(step, lr));
            }
            self.state.skipped += 1;
            let text = format!(
                "not finite, skipped: {}",
                patches_of(step, self.source.scenes())
            );
            return Ok(vec![text]);
        }
        self.skipped_in_a_row = 0;
        let means = &mut self.state.since_log;
        means.steps += 1;
        means.loss += step.loss;
        means.grad_norm += step.grad_norm;
        let setting = Setting {
            steps: self.config.train.steps,
            patches: self.source.patches().len() as u64,
            scenes: names,
        };
        let patches = step.patches.iter();
        let patches = patches.map(|(patch, loss)| (patch.scene as usize, *loss));
        Ok(self.state.watch.step(setting, step.loss, patches))
    }

    /// The error of a step that is not finite: everything that helps to find out why.
    fn not_finite(&self, step: &Step, lr: f64) -> String {
        let found = Store::new(self.dir.path()).newest_intact();
        let good = match found.ok().and_then(|found| found.intact) {
            Some(dir) => format!("the last good checkpoint is {}", dir.display()),
            None => "there is no checkpoint yet".into(),
        };
        let row = match self.skipped_in_a_row {
            1 => String::new(),
            count => format!(", for {count} steps in a row"),
        };
        format!(
            "step {}: loss {} and gradient norm {} at learning rate {lr:.3e}: not finite{row}; patches: {}; {good}; \
             a smaller train.lr_start or train.grad_clip may help, --set train.on_nan=skip drops such steps",
            self.state.step,
            step.loss,
            step.grad_norm,
            patches_of(step, self.source.scenes())
        )
    }

    /// Lets dormant channels begin anew, by numbers that depend on seed and step alone.
    fn recycle(&mut self, recorder: &mut Recorder) {
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.train.seed);
        rng.set_stream(self.state.step);
        let Census { dormant, channels } = self.trainer.recycle(&mut rng);
        if dormant > 0 {
            recorder.say(&format!(
                "step {}: {dormant} of {channels} channels were dormant and begin anew",
                self.state.step
            ));
        }
    }

    fn save(&self) -> anyhow::Result<()> {
        let bundle = self.bundle_of(self.trainer.model().valid());
        let average = self
            .trainer
            .average()
            .cloned()
            .map(|model| self.bundle_of(model));
        let keep = Keep {
            newest: self.config.run.keep,
            every: self.config.run.keep_every,
        };
        checkpoint::save(
            self.dir.path(),
            &bundle,
            average.as_ref(),
            self.trainer.optimizer(),
            &self.state,
            keep,
        )
    }

    /// Scores the validation scenes, draws them, and keeps the weights if they are the best so far.
    fn validate(&mut self, recorder: &mut Recorder) -> anyhow::Result<Option<Validation>> {
        if self.data.validation.is_empty() {
            return Ok(None);
        }
        let bundle = self.bundle_of(self.trainer.result());
        let found = validation::score(&bundle, &self.data.validation, validation::STRIP_SCENES)
            .context("validation")?;
        let step = self.state.step;
        if let Some(picture) = &found.picture {
            recorder.picture(step, picture)?;
        }
        let relmse = found.report.mean.denoised.relmse;
        if self.state.best.is_none_or(|best| relmse < best.relmse) {
            bundle.save(&self.best(), Names::Burn, Precision::F32)?;
            self.state.best = Some(Best { step, relmse });
        }
        Ok(Some(found))
    }

    fn best(&self) -> PathBuf {
        self.dir.path().join(BEST)
    }

    fn line(&self, lr: f64, validation: Option<&Validation>) -> Line {
        let Means {
            steps,
            loss,
            grad_norm,
        } = self.state.since_log;
        let denoised = validation.map(|found| &found.report.mean.denoised);
        let health = validation.map(|found| found.health);
        Line {
            step: self.state.step,
            epoch: (self.state.step * self.config.patches_per_step()) as f64
                / self.patches() as f64,
            loss: loss / steps as f64,
            lr,
            grad_norm: grad_norm / steps as f64,
            valid_relmse: denoised.map(|score| score.relmse),
            valid_ssim: denoised.and_then(|score| score.ssim),
            dead_channels: health.and_then(|health| health.dead_channels),
            zero_share: health.map(|health| health.zero_share),
            dormant: self.trainer.dormant().map(Census::share),
            skipped: self.state.skipped,
            patches_per_s: 0.0,
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

    /// A network of this run as it stands, with all that belongs to it.
    fn bundle_of(&self, model: Denoiser) -> Bundle {
        let meta = self.data.meta(self.config.model, self.state.step);
        Bundle { meta, model }
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
        let bundle = match self.state.best {
            Some(_) => Bundle::load(&self.best(), device)?,
            None => self.bundle_of(self.trainer.result()),
        };
        let Validation {
            report, picture, ..
        } = validation::score(&bundle, &self.data.test, usize::MAX).context("test")?;
        if let Some(picture) = picture {
            validation::write_strip(self.dir.path(), "test.png", &picture)?;
        }
        self.dir
            .write("test.json", &serde_json::to_vec_pretty(&report)?)?;
        Ok(Some((bundle.meta.step, report)))
    }
}
