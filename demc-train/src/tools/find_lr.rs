//! The learning-rate finder (Smith 2017): trains the initial network of a run with a rising
//! learning rate until the loss diverges.
//!
//! The loss of a single step depends mostly on its patches. So each loss is divided by the loss of
//! the untrained network on the same patches, and the ratio is smoothed.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context;
use demc_data::Batch;
use demc_program::file::write_whole;

use crate::config::Config;
use crate::run::data::{TrainingData, share_loader};
use crate::run::estimate::check_memory;
use crate::run::initial::{InitialNetwork, initial_network};
use crate::run::place::SessionPlace;
use crate::step::optimizer::Optimizer;
use crate::step::trainer::Trainer;
use crate::tools::chart::figure::{AxisScale, Figure, LinePanel, Series};
use crate::tools::chart::with_extension;

/// Weight of the previous value in the smoothed ratio; ours.
const SMOOTH: f64 = 0.9;
/// The sweep ends if the smoothed ratio is at least this multiple of its minimum; ours.
const DIVERGED: f64 = 4.0;
/// The suggestion is the rate of the minimum divided by this (Smith 2017).
const CAUTION: f64 = 10.0;
/// Steps before a sweep can end: the first ratios are 1.
const WARM_UP: usize = 10;

/// The learning rates of a sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RateRange {
    /// First rate.
    pub from: f64,
    /// Last rate.
    pub to: f64,
    /// Number of steps, each with the same factor to the next.
    pub steps: usize,
}

impl RateRange {
    fn rate(&self, step: usize) -> f64 {
        let done = step as f64 / (self.steps.max(2) - 1) as f64;
        self.from * (self.to / self.from).powf(done)
    }
}

/// One step of a sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SweepPoint {
    /// Learning rate.
    pub lr: f64,
    /// Loss before the step.
    pub loss: f64,
    /// Loss of the untrained network on the same patches.
    pub untrained: f64,
    /// Smoothed ratio of the two losses.
    pub smoothed: f64,
}

/// A finished sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// Every step, including the diverging ones at the end.
    pub points: Vec<SweepPoint>,
    /// Whether the loss diverged before the last rate.
    pub diverged: bool,
}

/// Sweeps over `range` with network, batches and optimizer of `config`, and calls `on_step` after
/// each step.
///
/// # Errors
/// A scene that cannot be read; a `train.init` of another network.
pub fn sweep(
    config: &Config,
    data: &TrainingData,
    range: RateRange,
    place: &SessionPlace,
    mut on_step: impl FnMut(&SweepPoint),
) -> anyhow::Result<Sweep> {
    let reduce = &place.reduce;
    check_memory(config, &place.device, reduce.on_node().count)?;
    let device = place.device.clone().autodiff();
    let network = || initial_network(config, data.normalizer.flat_color, &device);
    let InitialNetwork {
        model,
        albedo_filter,
        ..
    } = network()?;
    let source = data.patch_source(config, reduce.on_node(), albedo_filter.as_deref())?;
    let per_step = config.train.grad_accumulation;
    let own = reduce.share(per_step);
    let mut loader = share_loader(Arc::new(source), own.clone(), per_step, 0);
    let trainer = |model| {
        let optimizer = Optimizer::new(config);
        Trainer::new(config, model, optimizer, None, device.clone()).with_reduce(reduce.clone())
    };
    let (mut trained, untrained) = (trainer(model), trainer(network()?.model));
    let mut ratios = SweepRatios::default();
    for step in 0..range.steps {
        let batches: Result<Vec<Batch>, demc_data::Error> =
            own.clone().map(|_| loader.next()).collect();
        let batches = reduce.agree(batches.map_err(Into::into))?;
        let before = untrained.mean_loss(batches.iter().cloned())?;
        let lr = range.rate(step);
        let mut next = batches.into_iter();
        let report = trained.step(lr, || {
            Ok::<_, demc_data::Error>(next.next().expect("one batch per part of a step"))
        })?;
        let point = ratios.add(lr, report.loss, before);
        on_step(&point);
        if !report.is_finite() || ratios.diverged() {
            return Ok(Sweep {
                points: ratios.points,
                diverged: true,
            });
        }
    }
    Ok(Sweep {
        points: ratios.points,
        diverged: false,
    })
}

#[derive(Default)]
struct SweepRatios {
    points: Vec<SweepPoint>,
    sums: (f64, f64),
    least: Option<f64>,
}

impl SweepRatios {
    fn add(&mut self, lr: f64, loss: f64, untrained: f64) -> SweepPoint {
        let (ratio, weight) = self.sums;
        self.sums = (
            SMOOTH * ratio + (1.0 - SMOOTH) * loss / untrained,
            SMOOTH * weight + (1.0 - SMOOTH),
        );
        let smoothed = self.sums.0 / self.sums.1;
        let point = SweepPoint {
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
    /// The suggested initial rate: a tenth of the rate of the smallest smoothed ratio. `None` if
    /// the loss never fell.
    pub fn suggestion(&self) -> Option<f64> {
        let finite = self
            .points
            .iter()
            .filter(|point| point.smoothed.is_finite());
        let least = finite.min_by(|a, b| a.smoothed.total_cmp(&b.smoothed))?;
        (least.smoothed < 1.0).then(|| rounded(least.lr / CAUTION))
    }

    /// Writes STEM.csv and STEM.svg; their directory is created if missing.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, stem: &Path) -> anyhow::Result<[PathBuf; 2]> {
        let csv = with_extension(stem, "csv")?;
        if let Some(dir) = stem.parent().filter(|dir| !dir.as_os_str().is_empty()) {
            std::fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
        }
        write_whole(&csv, |file| {
            std::io::Write::write_all(file, self.csv().as_bytes())
        })?;
        let svg = self.figure().write(stem)?;
        Ok([csv, svg])
    }

    fn csv(&self) -> String {
        let mut text = String::from("step,lr,loss,untrained_loss,smoothed_ratio\n");
        for (step, point) in self.points.iter().enumerate() {
            let SweepPoint {
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
        let points = |value: &dyn Fn(&SweepPoint) -> f64| -> Vec<(f64, f64)> {
            self.points
                .iter()
                .map(|point| (point.lr, value(point)))
                .collect()
        };
        let raw = Series {
            name: "each step".into(),
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
        Figure(vec![LinePanel {
            title: "learning-rate sweep".into(),
            x_label: "learning rate".into(),
            y_label: "loss / loss of the untrained network".into(),
            x: AxisScale::Log,
            y: AxisScale::Log,
            series: vec![raw, smoothed],
            marks: marks.into_iter().collect(),
        }])
    }
}

/// Rounded to two digits: more would suggest a precision that a sweep does not have.
fn rounded(lr: f64) -> f64 {
    format!("{lr:.1e}").parse().unwrap_or(lr)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(ratios: impl Iterator<Item = f64>) -> Sweep {
        let mut ratios_so_far = SweepRatios::default();
        let mut diverged = false;
        for (i, ratio) in ratios.enumerate() {
            ratios_so_far.add(10f64.powf(i as f64 / 10.0 - 6.0), 2.0 * ratio, 2.0);
            diverged = ratios_so_far.diverged();
            if diverged {
                break;
            }
        }
        Sweep {
            points: ratios_so_far.points,
            diverged,
        }
    }

    #[test]
    fn rates_rise_by_a_constant_factor() {
        let range = RateRange {
            from: 1e-6,
            to: 1.0,
            steps: 7,
        };
        for step in 0..7 {
            let expected = 10f64.powi(step - 6);
            assert!((range.rate(step as usize) / expected - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn the_smoothed_ratio_of_equal_ratios_is_that_ratio() {
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
    fn a_sweep_ends_when_it_diverges_and_suggests_a_tenth_of_the_best_rate() {
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
    fn csv_has_a_row_per_step() {
        let csv = sweep((0..3).map(|_| 0.5)).csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 4);
        assert_eq!(lines[1], "0,1e-6,1,2,0.5");
    }
}
