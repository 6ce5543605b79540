//! Where a run's progress goes: `metrics.jsonl`, TensorBoard, the terminal.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use demc_infer::picture::Picture;

use crate::config::Config;
use crate::metrics_log::{Line, Metrics};
use crate::progress::Progress;
use crate::run_dir::RunDir;
use crate::tensorboard::Events;
use crate::validation::write_strip;

/// Directory of a run with its TensorBoard events.
const TENSORBOARD: &str = "tensorboard";

/// Records one session of a run.
pub struct Recorder {
    run: PathBuf,
    metrics: Metrics,
    events: Events,
    progress: Progress,
    pace: Pace,
}

impl Recorder {
    /// Opens the records of `dir` for the steps after `step`.
    ///
    /// # Errors
    /// A file that cannot be read or written.
    pub fn open(dir: &RunDir, config: &Config, step: u64, patches: usize) -> anyhow::Result<Self> {
        let metrics = dir.metrics(step)?;
        let mut events = Events::open(&dir.path().join(TENSORBOARD), step)?;
        if step == 0 {
            let text = format!("```toml\n{}```", config.to_toml());
            events.text(0, "config", &text)?;
        }
        let progress = Progress::new(step, config.train.steps, config.patches_per_step(), patches);
        if metrics.was_lost() {
            progress.line(format!(
                "note: {} was gone: it begins anew after step {step}",
                metrics.path().display()
            ));
        }
        let per_step = config.patches_per_step();
        Ok(Recorder {
            run: dir.path().into(),
            metrics,
            events,
            progress,
            pace: Pace::new(per_step),
        })
    }

    /// A step is done, which took `time`.
    pub fn step(&mut self, step: u64, loss: f64, time: Duration) {
        self.pace.step(time);
        self.progress.step(step, loss);
    }

    /// A line of the log, with the patches a second since the line before; what it says in words goes to the terminal.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn line(&mut self, mut line: Line, words: &str) -> anyhow::Result<()> {
        line.patches_per_s = self.pace.take();
        self.metrics.append(&line)?;
        self.events.scalars(line.step, &line.scalars())?;
        self.progress.line(words);
        Ok(())
    }

    /// The picture of a validation.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn picture(&mut self, step: u64, picture: &Picture) -> anyhow::Result<()> {
        write_strip(&self.run, &format!("step-{step:08}.png"), picture)?;
        let (width, height) = picture.size();
        let tag = "validation/noisy, detail map, denoised, reference";
        self.events
            .image(step, tag, width, height, &picture.to_png()?)
    }

    /// Says something that is no record.
    pub fn say(&self, text: &str) {
        self.progress.line(text);
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.progress.finish();
    }
}

/// Patches a second, over steps alone: what validation and writing take is not counted.
struct Pace {
    patches_per_step: u64,
    steps: u64,
    time: Duration,
}

impl Pace {
    fn new(patches_per_step: u64) -> Self {
        Pace {
            patches_per_step,
            steps: 0,
            time: Duration::ZERO,
        }
    }

    fn step(&mut self, time: Duration) {
        self.steps += 1;
        self.time += time;
    }

    /// The pace since the last time; 0 where there was no step.
    fn take(&mut self) -> f64 {
        let patches = (self.steps * self.patches_per_step) as f64;
        let seconds = self.time.as_secs_f64();
        (self.steps, self.time) = (0, Duration::ZERO);
        if seconds > 0.0 {
            patches / seconds
        } else {
            0.0
        }
    }
}

/// Measures a step.
pub fn timed<T>(work: impl FnOnce() -> T) -> (T, Duration) {
    let started = Instant::now();
    let done = work();
    (done, started.elapsed())
}
