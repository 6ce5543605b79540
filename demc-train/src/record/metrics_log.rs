//! `metrics.jsonl`: one object per line. Only `patches_per_s` and `elapsed_s` depend on the clock.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use demc_data::file::write_whole;
use demc_model::config::DETAIL_CHANNELS;
use serde::Serialize;

/// `metrics.jsonl`, open to append.
#[derive(Debug)]
pub struct MetricsLog {
    file: File,
    path: PathBuf,
    lost: bool,
}

/// One line of `metrics.jsonl`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MetricsLine {
    /// Steps so far, skipped ones included.
    pub step: u64,
    /// Epochs so far.
    pub epoch: f64,
    /// Mean training loss since the previous line; `null` if all steps were skipped.
    pub loss: f64,
    /// Learning rate of the last step.
    pub lr: f64,
    /// Mean gradient norm since the previous line, before clipping.
    pub grad_norm: f64,
    /// Mean RelMSE of the validation scenes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub valid_relmse: Option<f64>,
    /// Mean SSIM of the validation scenes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub valid_ssim: Option<f64>,
    /// Dead channels of the detail map: zero almost everywhere in the validation scenes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dead_channels: Option<usize>,
    /// Share of zeros in the output where the reference is above 0.01.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero_share: Option<f64>,
    /// Share of dormant channels: without a gradient for 175 steps, or ever.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dormant: Option<f64>,
    /// Steps skipped because of a non-finite loss or gradient.
    pub skipped: u64,
    /// Patches per second since the previous line, without validations and checkpoints.
    pub patches_per_s: f64,
    /// Seconds of training, without the time between sessions.
    pub elapsed_s: f64,
}

impl MetricsLine {
    /// The numbers as TensorBoard scalars.
    pub fn scalars(&self) -> Vec<(&'static str, f64)> {
        let always = [
            ("train/loss", Some(self.loss)),
            ("train/learning_rate", Some(self.lr)),
            ("train/gradient_norm", Some(self.grad_norm)),
            ("train/dormant_channels", self.dormant),
            ("train/patches_per_s", Some(self.patches_per_s)),
            ("train/skipped_steps", Some(self.skipped as f64)),
        ];
        let dead = self.dead_channels.map(|dead| dead as f64);
        let validation = [
            ("validation/RelMSE", self.valid_relmse),
            ("validation/SSIM", self.valid_ssim),
            (
                "validation/dead_detail_channels",
                dead.map(|dead| dead / DETAIL_CHANNELS as f64),
            ),
            ("validation/output_zero_share", self.zero_share),
        ];
        let all = always.into_iter().chain(validation);
        all.filter_map(|(tag, value)| Some((tag, value?))).collect()
    }
}

impl MetricsLog {
    /// The log at `path`, without the lines after `step` and without an incomplete last line.
    ///
    /// # Errors
    /// A log that cannot be read or written.
    pub fn open(path: &Path, step: u64) -> anyhow::Result<Self> {
        let lost = step > 0 && !path.exists();
        let text = if path.exists() {
            fs::read_to_string(path)
        } else {
            Ok(String::new())
        };
        let text = text.with_context(|| path.display().to_string())?;
        let kept: String = text
            .split_inclusive('\n')
            .take_while(|line| is_line_until(line, step))
            .collect();
        if kept.len() != text.len() {
            write_whole(path, |file| file.write_all(kept.as_bytes()))?;
        }
        let file = OpenOptions::new().create(true).append(true).open(path);
        Ok(MetricsLog {
            file: file.with_context(|| path.display().to_string())?,
            path: path.to_owned(),
            lost,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the lines of earlier steps are missing.
    pub fn was_lost(&self) -> bool {
        self.lost
    }

    /// Appends a line.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn append(&mut self, line: &MetricsLine) -> anyhow::Result<()> {
        let mut text = serde_json::to_string(line)?;
        text.push('\n');
        self.file
            .write_all(text.as_bytes())
            .with_context(|| self.path.display().to_string())
    }
}

/// The duration of a run in seconds, from the last line of its log.
pub fn elapsed(path: &Path) -> Option<f64> {
    let text = fs::read_to_string(path).ok()?;
    let mut lines = text.lines().rev();
    let line = lines.find_map(|line| serde_json::from_str::<serde_json::Value>(line).ok())?;
    line.get("elapsed_s")?.as_f64()
}

/// Whether `text` is a complete line of a step up to `step`.
fn is_line_until(text: &str, step: u64) -> bool {
    let line = text
        .strip_suffix('\n')
        .and_then(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    line.and_then(|line| line.get("step")?.as_u64())
        .is_some_and(|line_step| line_step <= step)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(step: u64) -> MetricsLine {
        let [epoch, loss, lr, grad_norm, elapsed_s] = [0.5, 0.1 + 0.2, 1e-4, 2.0, 3.0];
        MetricsLine {
            step,
            epoch,
            loss,
            lr,
            grad_norm,
            valid_relmse: None,
            valid_ssim: None,
            dead_channels: None,
            zero_share: None,
            dormant: None,
            skipped: 0,
            patches_per_s: 9.0,
            elapsed_s,
        }
    }

    #[test]
    fn lines_after_the_checkpoint_and_an_incomplete_line_are_removed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.jsonl");
        let mut metrics = MetricsLog::open(&path, 0).unwrap();
        for step in [10, 20, 30] {
            metrics.append(&line(step)).unwrap();
        }
        let whole = fs::read_to_string(&path).unwrap();
        fs::write(&path, format!("{whole}{{\"step\": 2")).unwrap();
        MetricsLog::open(&path, 20).unwrap();
        let cut = fs::read_to_string(&path).unwrap();
        assert_eq!(cut.lines().count(), 2);
        assert!(whole.starts_with(&cut));
    }

    #[test]
    fn lines_without_validation_have_no_validation_keys() {
        let json = serde_json::to_string(&line(1)).unwrap();
        assert!(
            json.starts_with("{\"step\":1,\"epoch\":0.5,\"loss\":0.30000000000000004,"),
            "{json}"
        );
        assert!(!json.contains("valid_"));
        assert_eq!(line(1).scalars().len(), 5);
    }
}
