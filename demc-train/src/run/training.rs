//! The training loop.

pub mod scores;

use std::sync::Arc;

use anyhow::{bail, ensure};
use burn::module::Module;
use burn::tensor::Device;
use demc_data::PatchSource;
use demc_infer::bundle::Bundle;
use demc_model::Denoiser;

use crate::config::{Config, OnNan};
use crate::ranks::Reduce;
use crate::record::metrics_log::MetricsLine;
use crate::record::recorder::{Recorder, timed};
use crate::run::checkpoint::store::CheckpointStore;
use crate::run::checkpoint::{self, Checkpoint, MetricSums, SessionClock, TrainingProgress};
use crate::run::data::{TrainingData, share_loader};
use crate::run::estimate::DurationEstimate;
use crate::run::initial::InitialWeights;
use crate::run::observer::TakenStep;
use crate::run::place::SessionPlace;
use crate::run::run_dir::RunDir;
use crate::run::run_record::RecordedSetup;
use crate::run::signals::Stopped;
use crate::run::starting_point::StartingPoint;
use crate::run::validation::Validation;
use crate::run::warnings::WarningContext;
use crate::step::optimizer::DormantChannels;
use crate::step::trainer::{StepReport, Trainer};

/// Consecutive skipped steps after which a run fails despite `train.on_nan = "skip"`; ours.
const MAX_SKIPPED: u64 = 100;

/// A run that can train.
pub struct TrainingRun {
    config: Config,
    data: TrainingData,
    dir: RunDir,
    source: Arc<PatchSource>,
    trainer: Trainer,
    /// The albedo filter of `train.init`: of the training scenes, and in every bundle of the run.
    albedo_filter: Option<Box<Bundle>>,
    state: TrainingProgress,
    /// The weights of `train.init`, if the run is new.
    initial: Option<InitialWeights>,
    /// Steps skipped since the last one that was taken.
    skipped_in_a_row: u64,
    reduce: Reduce,
}

impl TrainingRun {
    /// A new run, or the run of `checkpoint` at its step, which the processes of `reduce` train
    /// together. `device` has no autodiff.
    ///
    /// # Errors
    /// Scenes smaller than a patch; a checkpoint of another run; a `train.init` of another network.
    pub fn new(
        config: Config,
        mut data: TrainingData,
        dir: RunDir,
        checkpoint: Option<Checkpoint>,
        place: &SessionPlace,
    ) -> anyhow::Result<Self> {
        let device = place.device.clone().autodiff();
        let reduce = place.reduce.clone();
        let StartingPoint {
            model,
            albedo_filter,
            average,
            optimizer,
            state,
            initial,
        } = match checkpoint {
            Some(checkpoint) => {
                StartingPoint::of_checkpoint(checkpoint, &config, &mut data, dir.path())?
            }
            None => StartingPoint::of_new_run(&config, &mut data, &device)?,
        };
        let source = data.patch_source(&config, reduce.on_node(), albedo_filter.as_deref())?;
        let trainer =
            Trainer::new(&config, model, optimizer, average, device).with_reduce(reduce.clone());
        Ok(TrainingRun {
            config,
            data,
            dir,
            source: Arc::new(source),
            trainer,
            albedo_filter,
            state,
            initial,
            skipped_in_a_row: 0,
            reduce,
        })
    }

    /// The configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The weights of `train.init`, if the run is new.
    pub fn initial(&self) -> Option<&InitialWeights> {
        self.initial.as_ref()
    }

    /// Patches per epoch.
    pub fn patches(&self) -> usize {
        self.source.patches().len()
    }

    /// The estimated duration of the steps after `first_step` if so many processes share them, without
    /// their exchanges.
    pub fn estimate(&self, first_step: u64, device: &Device, processes: usize) -> DurationEstimate {
        let autodiff = device.clone().autodiff();
        DurationEstimate::measure(&self.config, &self.data, first_step, &autodiff, processes)
    }

    /// Number of trainable parameters.
    pub fn parameters(&self) -> u64 {
        self.config.model.parameter_count()
    }

    /// Trains to the last step, or until `observer`, which hears of every step, returns a signal: then
    /// the result is `Some`. `device` is the name of the device for the record.
    ///
    /// # Errors
    /// A scene that cannot be read; a file that cannot be written; a non-finite loss in a step
    /// that may not be skipped, or in all steps.
    pub fn train(
        &mut self,
        device: &str,
        mut observer: impl FnMut(&TakenStep) -> Option<i32>,
    ) -> anyhow::Result<Option<Stopped>> {
        let mut recorder = self.open_records(device)?;
        let (train, run) = (self.config.train.clone(), self.config.run.clone());
        let rate = self.config.learning_rate();
        let scenes: Vec<String> = self
            .data
            .train
            .iter()
            .map(|scene| scene.name.clone())
            .collect();
        let per_step = train.grad_accumulation;
        let share = self.reduce.share(per_step);
        let mut loader = share_loader(self.source.clone(), share, per_step, self.state.step);
        let mut clock = SessionClock::new(self.state.elapsed_s, run.checkpoint_interval());
        while self.state.step < train.steps {
            let lr = rate.at(self.state.step);
            let (report, time) = timed(|| self.trainer.step(lr, || loader.next()));
            let report = report?;
            let exchange = self.reduce.take_time();
            let mut warnings = self.count(&report, lr, &scenes)?;
            let step = self.state.step;
            recorder.step(step, report.loss, time, exchange);
            self.state.elapsed_s = clock.elapsed();
            let due = |every: u64| step.is_multiple_of(every) || step == train.steps;
            let mut validation = None;
            if due(run.validate_every) {
                validation = self.validate(&mut recorder)?;
            }
            if let Some(validation) = &validation {
                warnings.extend(self.state.watch.validation(&validation.health));
            }
            if due(run.log_every) || validation.is_some() {
                let line = self.metrics_line(lr, validation.as_ref());
                let watch = &mut self.state.watch;
                warnings.extend(line.dormant.and_then(|share| watch.dormant(share)));
                let is_best = self.state.best.is_some_and(|best| best.step == step);
                recorder.line(line, &line.describe(is_best))?;
                self.state.since_log = MetricSums::default();
            }
            for warning in warnings {
                recorder.say(&format!("warning: step {step}: {warning}"));
            }
            let taken = TakenStep::new([step, train.steps], &report, lr, validation.as_ref());
            let signal = observer(&taken);
            let (signal, is_time) = self.requests(signal, clock.checkpoint_is_due())?;
            if due(run.checkpoint_every) || is_time || signal.is_some() {
                self.save()?;
                clock.checkpoint_saved();
            }
            if let Some(signal) = signal.filter(|_| step < train.steps) {
                recorder.finish();
                return Ok(Some(Stopped { signal, step }));
            }
        }
        recorder.finish();
        ensure!(
            !self.is_untrained(),
            "all {} steps were skipped because of a non-finite loss or gradient, so the network is untrained; \
             inspect the data with demc-data doctor, or try a smaller optimizer.lr_start",
            self.state.step
        );
        Ok(None)
    }

    /// The first signal that a process received, and whether the first process's clock asks for a
    /// checkpoint. All processes get the same answer, so they stop after the same step.
    fn requests(&self, signal: Option<i32>, is_time: bool) -> anyhow::Result<(Option<i32>, bool)> {
        let requests = self.reduce.gather(Ok((signal, is_time)))?;
        let signal = requests.iter().find_map(|(signal, _)| *signal);
        Ok((
            signal,
            requests.first().is_some_and(|(_, is_time)| *is_time),
        ))
    }

    /// Whether no step has changed the weights.
    fn is_untrained(&self) -> bool {
        self.state.skipped == self.state.step
    }

    fn open_records(&mut self, device: &str) -> anyhow::Result<Recorder> {
        if !self.reduce.is_first() {
            return Ok(Recorder::silent());
        }
        let facts = RecordedSetup {
            device,
            operations: &self.trainer.operations(),
            parameters: self.parameters(),
            patches: self.patches(),
            initial: self.initial.as_ref(),
        };
        let notes = self.dir.open(&self.config, &self.data, facts)?;
        let recorder = Recorder::open(
            self.dir.path(),
            &self.config,
            self.state.step,
            self.patches(),
        )?;
        for note in notes {
            recorder.say(&format!("note: {note}"));
        }
        Ok(recorder)
    }

    fn count(
        &mut self,
        report: &StepReport,
        lr: f64,
        scenes: &[String],
    ) -> anyhow::Result<Vec<String>> {
        self.state.step += 1;
        if !report.is_finite() {
            self.skipped_in_a_row += 1;
            let skip = self.config.train.on_nan == OnNan::Skip;
            if !skip || self.skipped_in_a_row >= MAX_SKIPPED {
                bail!(self.non_finite(report, lr));
            }
            self.state.skipped += 1;
            let patches = report.describe_patches(self.source.scenes());
            return Ok(vec![format!(
                "non-finite loss or gradient, skipped: {patches}"
            )]);
        }
        self.skipped_in_a_row = 0;
        let sums = &mut self.state.since_log;
        sums.steps += 1;
        sums.loss += report.loss;
        sums.grad_norm += report.grad_norm;
        let facts = WarningContext {
            steps: self.config.train.steps,
            patches: self.source.patches().len() as u64,
            scenes,
        };
        let patches = report
            .patches
            .iter()
            .map(|(patch, loss)| (patch.scene as usize, *loss));
        Ok(self.state.watch.step(facts, report.loss, patches))
    }

    /// The error of a non-finite step, with everything that helps to find its cause.
    fn non_finite(&self, report: &StepReport, lr: f64) -> String {
        let search = CheckpointStore::new(self.dir.path()).newest_intact();
        let checkpoint = match search.ok().and_then(|search| search.intact) {
            Some(dir) => format!("the last intact checkpoint is {}", dir.display()),
            None => "there is no checkpoint yet".into(),
        };
        let row = match self.skipped_in_a_row {
            1 => String::new(),
            count => format!(" in {count} consecutive steps"),
        };
        format!(
            "step {}: non-finite loss or gradient{row}: loss {}, gradient norm {}, learning rate {lr:.3e}; \
             patches: {}; {checkpoint}; a smaller optimizer.lr_start or optimizer.max_grad_norm may help, \
             --set train.on_nan=skip skips such steps",
            self.state.step,
            report.loss,
            report.grad_norm,
            report.describe_patches(self.source.scenes())
        )
    }

    /// Writes a checkpoint, in the first process.
    fn save(&self) -> anyhow::Result<()> {
        if !self.reduce.is_first() {
            return Ok(());
        }
        let bundle = self.bundle(self.trainer.model().valid());
        let average = self
            .trainer
            .average()
            .cloned()
            .map(|model| self.bundle(model));
        checkpoint::save(
            self.dir.path(),
            &bundle,
            average.as_ref(),
            self.trainer.optimizer(),
            &self.state,
            self.config.run.keep,
        )
    }

    /// One sentence on which weights the run keeps, and why.
    pub fn kept_weights(&self) -> String {
        self.state.kept_weights(self.config.train.steps)
    }

    fn metrics_line(&self, lr: f64, validation: Option<&Validation>) -> MetricsLine {
        let MetricSums {
            steps,
            loss,
            grad_norm,
        } = self.state.since_log;
        let denoised = validation.map(|found| &found.report.mean.denoised);
        let health = validation.map(|found| found.health);
        MetricsLine {
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
            dormant: self.trainer.dormant().map(DormantChannels::share),
            skipped: self.state.skipped,
            patches_per_s: 0.0,
            elapsed_s: self.state.elapsed_s,
        }
    }

    fn bundle(&self, model: Denoiser) -> Bundle {
        Bundle {
            meta: self.data.meta(self.config.model, self.state.step),
            model,
            albedo_filter: self.albedo_filter.clone(),
        }
    }
}
