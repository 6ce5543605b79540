//! Writes the metrics of a run to `metrics.jsonl`, TensorBoard and the terminal.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use demc_infer::picture::Picture;
use demc_program::message::printable;

use crate::config::Config;
use crate::record::metrics_log::{METRICS, MetricsLine, MetricsLog, damaged_lines};
use crate::record::progress::StepProgress;
use crate::record::tensorboard::EventFile;

/// Directory of the TensorBoard events in a run directory.
const TENSORBOARD: &str = "tensorboard";

/// TensorBoard's name for the share of a step that processes spend on exchanges.
const EXCHANGE: &str = "train/exchange_share";

/// The records of one session.
pub struct Recorder(
    /// `None` if nothing is recorded.
    Option<Records>,
);

struct Records {
    run: PathBuf,
    metrics: MetricsLog,
    events: EventFile,
    progress: StepProgress,
    pace: Pace,
}

impl Recorder {
    /// Opens the records in the run directory `run` for the steps after `step`.
    ///
    /// # Errors
    /// A file that cannot be read or written.
    pub fn open(run: &Path, config: &Config, step: u64, patches: usize) -> anyhow::Result<Self> {
        let metrics = MetricsLog::open(&run.join(METRICS), step)?;
        let mut events = EventFile::open(&run.join(TENSORBOARD), step)?;
        if step == 0 {
            let text = format!("```toml\n{}```", config.to_toml());
            events.text(0, "config", &text)?;
        }
        let progress =
            StepProgress::new(step, config.train.steps, config.patches_per_step(), patches);
        if metrics.was_lost() {
            progress.line(format!(
                "note: {} was missing: it starts after step {step}",
                metrics.path().display()
            ));
        }
        if !metrics.damaged().is_empty() {
            progress.line(format!(
                "note: {}: {} removed",
                metrics.path().display(),
                damaged_lines(metrics.damaged())
            ));
        }
        let per_step = config.patches_per_step();
        Ok(Recorder(Some(Records {
            run: run.into(),
            metrics,
            events,
            progress,
            pace: Pace::new(per_step),
        })))
    }

    /// Records nothing: another process does.
    pub fn silent() -> Self {
        Recorder(None)
    }

    /// Records a step, its duration, and the part of it that went into exchanges with other processes.
    pub fn step(&mut self, step: u64, loss: f64, time: Duration, exchange: Duration) {
        if let Recorder(Some(records)) = self {
            records.pace.step(time, exchange);
            records.progress.step(step, loss);
        }
    }

    /// Writes a line of the log, with patches per second since the previous line, and `text` to the
    /// terminal.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn line(&mut self, mut line: MetricsLine, text: &str) -> anyhow::Result<()> {
        let Recorder(Some(records)) = self else {
            return Ok(());
        };
        let exchange = records.pace.exchange_share();
        line.patches_per_s = records.pace.take();
        records.metrics.append(&line)?;
        let mut scalars = line.scalars();
        scalars.extend(exchange.map(|share| (EXCHANGE, share)));
        records.events.scalars(line.step, &scalars)?;
        records.progress.line(match exchange {
            Some(share) => format!("{text}  exchange {:.1} %", 100.0 * share),
            None => text.to_owned(),
        });
        Ok(())
    }

    /// Writes the picture of a validation.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn picture(&mut self, step: u64, picture: &Picture) -> anyhow::Result<()> {
        let Recorder(Some(records)) = self else {
            return Ok(());
        };
        write_strip(&records.run, &format!("step-{step:08}.png"), picture)?;
        let (width, height) = picture.size();
        let tag = "validation/noisy, detail map, denoised, reference";
        records
            .events
            .image(step, tag, width, height, &picture.to_png()?)
    }

    /// Prints a line on the terminal alone.
    pub fn say(&self, text: &str) {
        if let Recorder(Some(records)) = self {
            records.progress.line(printable(text));
        }
    }

    /// Removes the progress bar.
    pub fn finish(&self) {
        if let Recorder(Some(records)) = self {
            records.progress.finish();
        }
    }
}

struct Pace {
    patches_per_step: u64,
    steps: u64,
    time: Duration,
    exchange: Duration,
}

impl Pace {
    fn new(patches_per_step: u64) -> Self {
        Pace {
            patches_per_step,
            steps: 0,
            time: Duration::ZERO,
            exchange: Duration::ZERO,
        }
    }

    fn step(&mut self, time: Duration, exchange: Duration) {
        self.steps += 1;
        self.time += time;
        self.exchange += exchange;
    }

    /// Share of the time since the last `take` that went into exchanges; `None` without any.
    fn exchange_share(&self) -> Option<f64> {
        let share = self.exchange.as_secs_f64() / self.time.as_secs_f64();
        (!self.exchange.is_zero()).then_some(share)
    }

    /// Patches per second since the last call; 0 without a step.
    fn take(&mut self) -> f64 {
        let patches = (self.steps * self.patches_per_step) as f64;
        let seconds = self.time.as_secs_f64();
        (self.steps, self.time, self.exchange) = (0, Duration::ZERO, Duration::ZERO);
        if seconds > 0.0 {
            patches / seconds
        } else {
            0.0
        }
    }
}

/// Writes a picture into the run directory.
///
/// # Errors
/// A file that cannot be written.
pub fn write_strip(run: &Path, name: &str, picture: &Picture) -> anyhow::Result<()> {
    let dir = run.join("strips");
    std::fs::create_dir_all(&dir).with_context(|| dir.display().to_string())?;
    Ok(picture.write_png(&dir.join(name))?)
}

/// The result of `work` and its duration.
pub fn timed<T>(work: impl FnOnce() -> T) -> (T, Duration) {
    let started = Instant::now();
    let result = work();
    (result, started.elapsed())
}
