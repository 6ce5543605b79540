//! The learning-rate finder (Smith 2017): trains the network that a run begins with while the rate climbs, until the loss diverges.
//!
//! The loss of a step says more about its patches than about the rate: here it is a ratio to what the untrained network loses
//! on the same patches, and smoothed.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_data::file::write_whole;
use demc_data::{Batch, BatchLoader, PatchSource};

use crate::chart::{Figure, Panel, Scale, Series, with_kind};
use crate::config::Config;
use crate::data::Data;
use crate::initial::{Initial, initial_model};
use crate::optimizer::Optimizer;
use crate::trainer::Trainer;

/// What a smoothed ratio keeps of the one before; ours.
const SMOOTH: f64 = 0.9;
/// The sweep ends where the smoothed ratio is this many times its smallest; ours.
const DIVERGED: f64 = 4.0;
/// The suggestion is the rate of the smallest ratio divided by this (Smith's habit).
const CAUTION: f64 = 10.0;
/// Steps before a sweep may end: the first ratios are 1.
const WARM_UP: usize = 10;

/// Between which rates, in how many steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// First rate.
    pub from: f64,
    /// Last rate.
    pub to: f64,
    /// Steps from the one to the other, by the same factor each.
    pub steps: usize,
}

impl Range {
    fn at(&self, step: usize) -> f64 {
        let done = step as f64 / (self.steps.max(2) - 1) as f64;
        self.from * (self.to / self.from).powf(done)
    }
}

/// One step of a sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Learning rate.
    pub lr: f64,
    /// Loss before the step.
    pub loss: f64,
    /// Loss of the untrained network on the same patches.
    pub untrained: f64,
    /// Their ratio, smoothed over the steps so far.
    pub smoothed: f64,
}

/// A finished sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// Every step, the diverging ones at the end included.
    pub points: Vec<Point>,
    /// Whether the loss diverged before the range's end.
    pub diverged: bool,
}

/// Sweeps over `range` with the network, the batches and the optimizer of `config`. `device` is plain; `seen` hears of each
/// step.
///
/// # Errors
/// A scene that cannot be read; a `train.init` that does not fit.
pub fn sweep(
    config: &Config,
    data: &Data,
    range: Range,
    device: &Device,
    mut seen: impl FnMut(&Point),
) -> anyhow::Result<Sweep> {
    let source = PatchSource::new(
        &config.data,
        data.train.clone(),
        data.layout.clone(),
        data.normalizer.clone(),
        config.train.seed,
    )?;
    let mut loader = BatchLoader::new(Arc::new(source), 0);
    let device = device.clone().autodiff();
    let trainer = || -> anyhow::Result<Trainer> {
        let Initial { model, .. } = initial_model(config, data.normalizer.flat_color, &device)?;
        let optimizer = Optimizer::new(&config.train);
        Ok(Trainer::new(config, model, optimizer, None, device.clone()))
    };
    let (mut trained, untrained) = (trainer()?, trainer()?);
    let mut found = Ratios::default();
    for step in 0..range.steps {
        let batches: Result<Vec<Batch>, demc_data::Error> = (0..config.train.grad_accumulation)
            .map(|_| loader.next())
            .collect();
        let batches = batches?;
        let before = untrained.mean_loss(&batches);
        let lr = range.at(step);
        let mut next = batches.into_iter();
        let step = trained.step(lr, || {
            Ok::<_, demc_data::Error>(next.next().expect("as many as a step takes"))
        })?;
        let finite = step.is_finite();
        let point = found.take(lr, step.loss, before);
        seen(&point);
        if !finite || found.diverged() {
            return Ok(Sweep {
                points: found.points,
                diverged: true,
            });
        }
    }
    Ok(Sweep {
        points: found.points,
        diverged: false,
    })
}

/// The ratios so far.
#[derive(Default)]
struct Ratios {
    points: Vec<Point>,
    /// Weighted sum of the ratios, and of the weights.
    sums: (f64, f64),
    least: Option<f64>,
}

impl Ratios {
    fn take(&mut self, lr: f64, loss: f64, untrained: f64) -> Point {
        let (ratio, weight) = self.sums;
        self.sums = (
            SMOOTH * ratio + (1.0 - SMOOTH) * loss / untrained,
            SMOOTH * weight + (1.0 - SMOOTH),
        );
        let smoothed = self.sums.0 / self.sums.1;
        let point = Point {
            lr,
            loss,
            untrained,
            smoothed,
        };
        self.points.push(point);
        if smoothed.is_finite() {
            self.least = Some(self.least.map_or(smoothed, |least| least.min(smoothed)));
        }
        point
    }

    fn diverged(&self) -> bool {
        let last = self.points.last().map_or(0.0, |point| point.smoothed);
        let limit = self.least.map_or(f64::INFINITY, |least| DIVERGED * least);
        !last.is_finite() || (self.points.len() > WARM_UP && last >= limit)
    }
}

impl Sweep {
    /// The rate to start a run with: a tenth of the one with the smallest smoothed ratio; `None` where the loss never fell.
    pub fn suggestion(&self) -> Option<f64> {
        let finite = self
            .points
            .iter()
            .filter(|point| point.smoothed.is_finite());
        let least = finite.min_by(|a, b| a.smoothed.total_cmp(&b.smoothed))?;
        (least.smoothed < 1.0).then(|| rounded(least.lr / CAUTION))
    }

    /// Writes STEM.csv, STEM.svg and STEM.png, whose directory is made where it is missing.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, stem: &Path) -> anyhow::Result<[PathBuf; 3]> {
        ensure!(
            stem.file_name().is_some(),
            "{}: names no file",
            stem.display()
        );
        if let Some(dir) = stem.parent().filter(|dir| !dir.as_os_str().is_empty()) {
            std::fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
        }
        let csv = with_kind(stem, "csv");
        write_whole(&csv, |file| {
            std::io::Write::write_all(file, self.csv().as_bytes())
        })?;
        let [svg, png] = self.figure().write(stem)?;
        Ok([csv, svg, png])
    }

    fn csv(&self) -> String {
        let mut text = String::from("step,lr,loss,untrained_loss,smoothed_ratio\n");
        for (step, point) in self.points.iter().enumerate() {
            let Point {
                lr,
                loss,
                untrained,
                smoothed,
            } = point;
            let _ = writeln!(text, "{step},{lr:e},{loss},{untrained},{smoothed}");
        }
        text
    }

    fn figure(&self) -> Figure {
        let points = |of: &dyn Fn(&Point) -> f64| -> Vec<(f64, f64)> {
            self.points
                .iter()
                .map(|point| (point.lr, of(point)))
                .collect()
        };
        let raw = Series {
            name: "of each step".into(),
            points: points(&|point| point.loss / point.untrained),
            faint: true,
            color: 0,
        };
        let smoothed = Series {
            name: "smoothed".into(),
            points: points(&|point| point.smoothed),
            faint: false,
            color: 0,
        };
        let marks = self
            .suggestion()
            .map(|lr| (lr, format!("suggested: {lr:.1e}")));
        Figure::Lines(vec![Panel {
            title: "learning-rate sweep".into(),
            x_label: "learning rate".into(),
            y_label: "loss / that of the untrained network".into(),
            x: Scale::Log,
            y: Scale::Log,
            series: vec![raw, smoothed],
            marks: marks.into_iter().collect(),
        }])
    }
}

/// To two digits: a suggestion is no measurement.
fn rounded(lr: f64) -> f64 {
    format!("{lr:.1e}").parse().unwrap_or(lr)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sweep over rates from 1e-6 by factors of 10^(1/10) with these ratios.
    fn sweep(ratios: impl Iterator<Item = f64>) -> Sweep {
        let mut found = Ratios::default();
        let mut diverged = false;
        for (i, ratio) in ratios.enumerate() {
            found.take(10f64.powf(i as f64 / 10.0 - 6.0), 2.0 * ratio, 2.0);
            diverged = found.diverged();
            if diverged {
                break;
            }
        }
        Sweep {
            points: found.points,
            diverged,
        }
    }

    #[test]
    fn rates_climb_by_one_factor_from_end_to_end() {
        let range = Range {
            from: 1e-6,
            to: 1.0,
            steps: 7,
        };
        for step in 0..7 {
            let expected = 10f64.powi(step - 6);
            assert!((range.at(step as usize) / expected - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn smoothed_ratio_of_equal_ones_is_that_ratio() {
        let sweep = sweep((0..20).map(|_| 0.5));
        assert!(
            sweep
                .points
                .iter()
                .all(|p| (p.smoothed - 0.5).abs() < 1e-12)
        );
        assert!(!sweep.diverged);
    }

    /// Falls until 1e-2 (i = 40), then explodes.
    #[test]
    fn a_sweep_ends_where_it_diverges_and_suggests_less_than_the_best_rate() {
        let ratio = |i: i32| {
            if i <= 40 {
                1.0 - 0.02 * f64::from(i)
            } else {
                20.0
            }
        };
        let sweep = sweep((0..60).map(ratio));
        assert!(
            sweep.diverged && sweep.points.len() < 45,
            "{}",
            sweep.points.len()
        );
        assert_eq!(sweep.suggestion(), Some(1e-3));
    }

    #[test]
    fn a_loss_that_never_falls_suggests_nothing() {
        assert_eq!(
            sweep((0..30).map(|i| 1.0 + f64::from(i) / 10.0)).suggestion(),
            None
        );
        assert_eq!(sweep([f64::NAN].into_iter()).suggestion(), None);
    }

    #[test]
    fn csv_has_a_row_a_step() {
        let csv = sweep((0..3).map(|_| 0.5)).csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 4);
        assert_eq!(lines[1], "0,1e-6,1,2,0.5");
    }
}
