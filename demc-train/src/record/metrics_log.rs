//! `metrics.jsonl`: one object per line. Only `patches_per_s` and `elapsed_s` depend on the clock.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use demc_model::config::DETAIL_CHANNELS;
use demc_program::file::write_whole;
use demc_program::message::short_list;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// The log in a run directory.
pub const METRICS: &str = "metrics.jsonl";

/// `metrics.jsonl`, open to append.
#[derive(Debug)]
pub struct MetricsLog {
    file: File,
    path: PathBuf,
    lost: bool,
    damaged: Vec<usize>,
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
    /// The line of the terminal; `is_best` marks the best validation so far.
    pub fn describe(&self, is_best: bool) -> String {
        let MetricsLine { step, loss, lr, .. } = self;
        let mut text = format!("step {step:>6}  loss {loss:.4}  lr {lr:.2e}");
        if let (Some(relmse), Some(ssim)) = (self.valid_relmse, self.valid_ssim) {
            text += &format!("  validation RelMSE {relmse:.4}  SSIM {ssim:.4}");
        }
        if is_best {
            text += "  best";
        }
        text
    }

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
    /// The log at `path`, without the lines after `step`, an incomplete last line, and damaged
    /// lines.
    ///
    /// # Errors
    /// A log that cannot be read or written.
    pub fn open(path: &Path, step: u64) -> anyhow::Result<Self> {
        let lost = step > 0 && !path.exists();
        let bytes = if path.exists() {
            fs::read(path).with_context(|| path.display().to_string())?
        } else {
            Vec::new()
        };
        let StoredLines { lines, damaged } = read_lines::<LineStep>(&bytes);
        let kept: Vec<u8> = lines
            .iter()
            .filter(|(_, line)| line.step <= step)
            .flat_map(|(text, _)| *text)
            .copied()
            .collect();
        if kept.len() != bytes.len() {
            write_whole(path, |file| file.write_all(&kept))?;
        }
        let file = OpenOptions::new().create(true).append(true).open(path);
        Ok(MetricsLog {
            file: file.with_context(|| path.display().to_string())?,
            path: path.to_owned(),
            lost,
            damaged,
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

    /// The numbers of the damaged lines that were removed, from 1.
    pub fn damaged(&self) -> &[usize] {
        &self.damaged
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

/// The duration of a run in seconds, from the last intact line of its log.
pub fn elapsed(path: &Path) -> Option<f64> {
    let bytes = fs::read(path).ok()?;
    let StoredLines { lines, .. } = read_lines::<LineTime>(&bytes);
    lines.last().map(|(_, line)| line.elapsed_s)
}

#[derive(Deserialize)]
struct LineTime {
    elapsed_s: f64,
}

/// The key that every line has.
#[derive(Deserialize)]
struct LineStep {
    step: u64,
}

/// The lines of a log.
pub struct StoredLines<'a, T> {
    /// Each intact line with its text, line feed included.
    pub lines: Vec<(&'a [u8], T)>,
    /// The numbers of the others, from 1.
    pub damaged: Vec<usize>,
}

/// Parses a log. A damaged line costs that line alone. An incomplete last line is what a killed
/// process leaves, and counts as neither.
pub fn read_lines<T: DeserializeOwned>(bytes: &[u8]) -> StoredLines<'_, T> {
    let mut found = StoredLines {
        lines: Vec::new(),
        damaged: Vec::new(),
    };
    for (index, line) in bytes.split_inclusive(|byte| *byte == b'\n').enumerate() {
        match serde_json::from_slice(line) {
            Ok(parsed) if line.ends_with(b"\n") => found.lines.push((line, parsed)),
            Err(_) if line.ends_with(b"\n") => found.damaged.push(index + 1),
            _ => {}
        }
    }
    found
}

/// `damaged lines 3, 7`
pub fn damaged_lines(numbers: &[usize]) -> String {
    let plural = if numbers.len() == 1 { "" } else { "s" };
    let names: Vec<String> = numbers.iter().map(usize::to_string).collect();
    format!("damaged line{plural} {}", short_list(&names))
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
    fn a_damaged_line_costs_that_line_alone() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("metrics.jsonl");
        let intact: [&[u8]; 2] = [b"{\"step\":1}\n", b"{\"step\":3}\n"];
        let damaged: [&[u8]; 4] = [b"\xff\x00\n", b"{\"step\":-2}\n", b"[]\n", b"\n"];
        for line in damaged {
            fs::write(&path, [intact[0], line, intact[1]].concat()).unwrap();
            let log = MetricsLog::open(&path, 3).unwrap();
            assert_eq!(log.damaged(), [2]);
            assert_eq!(fs::read(&path).unwrap(), intact.concat());
        }
        assert_eq!(damaged_lines(&[2]), "damaged line 2");
        assert_eq!(damaged_lines(&[2, 5]), "damaged lines 2, 5");
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
