//! A progress bar on stderr. It is hidden if stderr is no terminal.

use std::fmt::Display;

use demc_program::message;
use indicatif::{ProgressBar, ProgressStyle};

pub struct Progress(ProgressBar);

impl Progress {
    pub fn new(total: usize) -> Self {
        let style = ProgressStyle::with_template("{bar:30} {pos}/{len}  {wide_msg}  {eta} left")
            .expect("a constant template");
        Self(ProgressBar::new(total as u64).with_style(style))
    }

    pub fn start(&self, name: impl Display) {
        self.0.set_message(message::printable(&name.to_string()));
    }

    pub fn advance(&self) {
        self.0.inc(1);
    }

    /// Prints a line on stderr that the bar does not overwrite.
    pub fn line(&self, line: impl Display) {
        self.0.suspend(|| message::say(line));
    }

    pub fn finish(self) {
        self.0.finish_and_clear();
    }
}
