//! The progress bar on stderr, and lines on stdout that the bar does not overwrite.

use std::fmt::Display;
use std::time::Instant;

use demc_program::message;
use indicatif::{ProgressBar, ProgressStyle};

/// A progress bar over the steps of a run. It is hidden if stderr is not a terminal.
pub struct StepProgress {
    bar: ProgressBar,
    started: Instant,
    patches_per_step: u64,
    steps_per_epoch: f64,
    first: u64,
}

impl StepProgress {
    /// A bar at step `first` of `steps`. It is hidden in a process that prints nothing.
    pub fn new(first: u64, steps: u64, patches_per_step: u64, patches_per_epoch: usize) -> Self {
        let style =
            ProgressStyle::with_template("{bar:16} step {pos}/{len}  {eta} left  {wide_msg}")
                .expect("a constant template");
        let bar = if message::is_silent() {
            ProgressBar::hidden()
        } else {
            ProgressBar::new(steps)
        };
        let bar = bar.with_style(style).with_position(first);
        bar.reset_eta();
        let steps_per_epoch = patches_per_epoch as f64 / patches_per_step as f64;
        StepProgress {
            bar,
            started: Instant::now(),
            patches_per_step,
            steps_per_epoch,
            first,
        }
    }

    /// Advances the bar to `step`, which had this loss.
    pub fn step(&self, step: u64, loss: f64) {
        let rate = ((step - self.first) * self.patches_per_step) as f64
            / self.started.elapsed().as_secs_f64();
        let epoch = step as f64 / self.steps_per_epoch;
        self.bar.set_message(format!(
            "epoch {epoch:.1}  loss {loss:.4}  {rate:.1} patches/s"
        ));
        self.bar.set_position(step);
    }

    /// Prints a line on stdout.
    pub fn line(&self, line: impl Display) {
        self.bar.suspend(|| say(line));
    }

    /// Removes the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// Prints a line on stdout. A closed pipe (`| head`) does not stop the training.
pub fn say(line: impl Display) {
    message::status(line);
}
