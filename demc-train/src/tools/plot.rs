//! Curves of runs: training loss (as in the paper's Fig. 6), validation RelMSE and SSIM.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::Deserialize;

use demc_program::exit::UsageError;

use crate::record::metrics_log::{METRICS, StoredLines, damaged_lines, read_lines};
use crate::tools::chart::figure::{AxisScale, Figure, LinePanel, Series};

/// Options of the curves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlotOptions {
    /// Weight of earlier values in the exponential mean of the training loss, 0 (none) to below 1.
    /// The mean is bias-corrected.
    pub smooth: f64,
    /// Linear instead of logarithmic axes for loss and RelMSE.
    pub linear: bool,
}

/// Drawn curves.
#[derive(Clone, Debug, PartialEq)]
pub struct Curves {
    /// The chart.
    pub path: PathBuf,
    /// A note for each log with damaged lines.
    pub notes: Vec<String>,
}

#[derive(Clone, Copy, Debug, Deserialize)]
struct LoggedValues {
    step: u64,
    loss: Option<f64>,
    valid_relmse: Option<f64>,
    valid_ssim: Option<f64>,
}

/// Draws the curves of run directories to STEM.svg: smoothed training loss over its faint raw
/// values, and validation RelMSE and SSIM if any.
///
/// Each run has one colour and the shortest unique end of its path as name. Damaged lines of a log
/// and an incomplete last one are skipped.
///
/// # Errors
/// [`UsageError`]: no runs, a run named twice, a weight outside 0 to 1. A run without a log; no value
/// in any log; a file that cannot be written.
pub fn plot(runs: &[PathBuf], stem: &Path, options: &PlotOptions) -> anyhow::Result<Curves> {
    if runs.is_empty() {
        return Err(UsageError("no runs to plot".into()).into());
    }
    if !(0.0..1.0).contains(&options.smooth) {
        let smooth = options.smooth;
        let text = format!("smoothing: expected a weight from 0 to below 1, found {smooth}");
        return Err(UsageError(text).into());
    }
    let names = names(runs)?;
    let mut logs = Vec::with_capacity(runs.len());
    let mut notes = Vec::new();
    for run in runs {
        let (lines, note) = log(&run.join(METRICS))?;
        logs.push(lines);
        notes.extend(note);
    }
    let named: Vec<_> = names.iter().zip(&logs).collect();
    let panels = panels(&named, options);
    let has_points = |panel: &LinePanel| {
        let mut points = panel.series.iter().flat_map(|curve| &curve.points);
        points.any(|point| point.1.is_finite())
    };
    ensure!(
        panels.iter().any(has_points),
        "{}: no values to draw yet",
        runs[0].join(METRICS).display()
    );
    let path = Figure(panels).write(stem)?;
    Ok(Curves { path, notes })
}

/// The values of a log, and a note about damaged lines.
fn log(path: &Path) -> anyhow::Result<(Vec<LoggedValues>, Option<String>)> {
    let bytes = fs::read(path)
        .with_context(|| format!("{}: cannot read the log of a run", path.display()))?;
    let StoredLines { lines, damaged } = read_lines(&bytes);
    let skipped = || format!("{}: {} skipped", path.display(), damaged_lines(&damaged));
    let note = (!damaged.is_empty()).then(skipped);
    Ok((lines.into_iter().map(|(_, values)| values).collect(), note))
}

/// Training loss, and validation RelMSE and SSIM if a run has any.
fn panels(runs: &[(&String, &Vec<LoggedValues>)], options: &PlotOptions) -> Vec<LinePanel> {
    let scale = if options.linear {
        AxisScale::Linear
    } else {
        AxisScale::Log
    };
    let mut losses = Vec::new();
    for (color, (name, lines)) in runs.iter().enumerate() {
        let mut raw = curve(name, color, lines, |line| line.loss);
        if options.smooth > 0.0 {
            let mut smooth = raw.clone();
            smooth.points = smoothed(&raw.points, options.smooth, scale);
            losses.push(smooth);
            raw.faint = true;
        }
        losses.push(raw);
    }
    let validation = |value: fn(&LoggedValues) -> Option<f64>| {
        let curves = runs.iter().enumerate().map(|(color, (name, lines))| {
            let mut curve = curve(name, color, lines, value);
            // Lines without validation are not gaps.
            curve.points.retain(|point| point.1.is_finite());
            curve
        });
        curves.collect()
    };
    let mut panels = vec![
        panel(
            "validation RelMSE",
            "RelMSE",
            scale,
            validation(|line| line.valid_relmse),
        ),
        panel(
            "validation SSIM",
            "SSIM",
            AxisScale::Linear,
            validation(|line| line.valid_ssim),
        ),
    ];
    // Without held-out scenes there is no validation.
    panels.retain(|panel| panel.series.iter().any(|curve| !curve.points.is_empty()));
    panels.insert(0, panel("training loss", "loss", scale, losses));
    panels
}

fn panel(title: &str, y_label: &str, y: AxisScale, series: Vec<Series>) -> LinePanel {
    LinePanel {
        title: title.to_string(),
        x_label: "step".to_string(),
        y_label: y_label.to_string(),
        x: AxisScale::Linear,
        y,
        series,
        marks: Vec::new(),
    }
}

fn curve(
    name: &str,
    color: usize,
    lines: &[LoggedValues],
    value: impl Fn(&LoggedValues) -> Option<f64>,
) -> Series {
    let points = lines
        .iter()
        .map(|line| (line.step as f64, value(line).unwrap_or(f64::NAN)));
    Series {
        name: name.to_string(),
        points: points.collect(),
        faint: false,
        color,
    }
}

/// The exponential mean `m_n = w m_(n-1) + (1 - w) y_n` from `m_0 = 0`, divided by `1 - w^n`, the
/// sum of its weights. On a logarithmic axis it is the mean of the logarithms, so that a high start
/// fades sooner. Values that the axis cannot show stay as they are and do not count.
fn smoothed(points: &[(f64, f64)], weight: f64, scale: AxisScale) -> Vec<(f64, f64)> {
    let (mut mean, mut missing) = (0.0, 1.0);
    let [forward, back]: [fn(f64) -> f64; 2] = match scale {
        AxisScale::Linear => [|y| y, |y| y],
        AxisScale::Log => [f64::ln, f64::exp],
    };
    let smooth = |&(x, y): &(f64, f64)| {
        let value = forward(y);
        if !value.is_finite() {
            return (x, y);
        }
        mean = weight * mean + (1.0 - weight) * value;
        missing *= weight;
        (x, back(mean / (1.0 - missing)))
    };
    points.iter().map(smooth).collect()
}

/// The shortest end of each path that no other path has.
fn names(runs: &[PathBuf]) -> anyhow::Result<Vec<String>> {
    let mut paths = Vec::new();
    for run in runs {
        let path = std::path::absolute(run).with_context(|| run.display().to_string())?;
        // `components` drops a slash at the end and dots between.
        paths.push(path.components().collect::<PathBuf>());
    }
    let mut seen = HashSet::new();
    for (run, path) in runs.iter().zip(&paths) {
        if !seen.insert(path) {
            return Err(UsageError(format!("{}: named twice", run.display())).into());
        }
    }
    let name = |path: &PathBuf| {
        let depth = path.components().count();
        let is_alone =
            |end: &PathBuf| paths.iter().filter(|other| other.ends_with(end)).count() == 1;
        let ends =
            (1..=depth).map(|kept| path.components().skip(depth - kept).collect::<PathBuf>());
        let shortest = ends.into_iter().find(is_alone);
        let shown = shortest.as_ref().unwrap_or(path);
        // Escapes bytes that are not UTF-8, so that names stay different.
        shown
            .to_str()
            .map_or_else(|| format!("{shown:?}"), str::to_owned)
    };
    Ok(paths.iter().map(name).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOG: &str = "{\"step\":25,\"epoch\":0.1,\"loss\":1.5,\"lr\":0.002,\"grad_norm\":13.2,\"elapsed_s\":2.7}\n\
        {\"step\":50,\"epoch\":0.2,\"loss\":null,\"lr\":0.002,\"new_key\":[1],\"valid_relmse\":0.4,\"valid_ssim\":0.5}\n\
        {\"step\":75,\"loss\":0.7,\"valid_relmse\":0.3,\"valid_ssim\":0.6}\n";
    const OPTIONS: PlotOptions = PlotOptions {
        smooth: 0.9,
        linear: false,
    };

    fn run(dir: &Path, name: &str, log: &str) -> PathBuf {
        let run = dir.join(name);
        fs::create_dir_all(&run).unwrap();
        fs::write(run.join(METRICS), log).unwrap();
        run
    }

    fn failure(runs: &[PathBuf], stem: &Path, options: &PlotOptions) -> String {
        format!("{:#}", plot(runs, stem, options).unwrap_err())
    }

    #[test]
    fn smoothing_is_bias_corrected() {
        let points = [(1.0, 4.0), (2.0, f64::NAN), (3.0, 1.0), (4.0, 2.0)];
        let smooth = smoothed(&points, 0.5, AxisScale::Linear);
        // Means 2, 1.5, 1.75 over 1/2, 3/4, 7/8.
        assert_eq!(
            [smooth[0], smooth[2], smooth[3]],
            [(1.0, 4.0), (3.0, 2.0), (4.0, 2.0)]
        );
        assert!(smooth[1].1.is_nan());
        let constant: Vec<_> = (0..100).map(|x| (f64::from(x), 0.3)).collect();
        let smooth = smoothed(&constant, 0.97, AxisScale::Linear);
        // A hundred roundings and a division by 0.03.
        assert!(
            smooth.iter().all(|point| (point.1 - 0.3).abs() < 1e-13),
            "{smooth:?}"
        );
        assert_eq!(smoothed(&constant, 0.0, AxisScale::Linear), constant);
    }

    #[test]
    fn runs_are_named_by_the_shortest_unique_end() {
        let named = |runs: &[&str]| names(&runs.iter().map(PathBuf::from).collect::<Vec<_>>());
        let found = named(&["/r/a/one/", "/r/b/one", "/r/b/./two", "/three"]).unwrap();
        assert_eq!(found, ["a/one", "b/one", "two", "three"]);
        assert_eq!(named(&["/one", "/b/one"]).unwrap(), ["/one", "b/one"]);
        let error = named(&["/r/one", "/r/one/"]).unwrap_err().to_string();
        assert_eq!(error, "/r/one/: named twice");
    }

    #[test]
    fn a_log_with_validation_has_three_panels() {
        let dir = tempfile::tempdir().unwrap();
        let run = run(dir.path(), "a", LOG);
        let (lines, _) = log(&run.join(METRICS)).unwrap();
        let drawn = panels(&[(&"a".to_string(), &lines)], &OPTIONS);
        let [loss, relmse, ssim] = &drawn[..] else {
            panic!("{} panels", drawn.len())
        };
        assert_eq!(
            (loss.y, relmse.y, ssim.y),
            (AxisScale::Log, AxisScale::Log, AxisScale::Linear)
        );
        let faint: Vec<_> = loss.series.iter().map(|series| series.faint).collect();
        assert_eq!(faint, [false, true]);
        assert_eq!(loss.series[1].points[2], (75.0, 0.7));
        assert!(loss.series[1].points[1].1.is_nan(), "null is a gap");
        assert_eq!(relmse.series[0].points, [(50.0, 0.4), (75.0, 0.3)]);
        assert_eq!(ssim.series[0].points, [(50.0, 0.5), (75.0, 0.6)]);
        let plain = PlotOptions {
            smooth: 0.0,
            linear: true,
        };
        let drawn = panels(&[(&"a".to_string(), &lines)], &plain);
        assert_eq!(drawn[0].series.len(), 1);
        assert!(!drawn[0].series[0].faint);
        assert!(drawn.iter().all(|panel| panel.y == AxisScale::Linear));
    }

    #[test]
    fn an_incomplete_end_is_skipped_and_a_damaged_line_named() {
        let dir = tempfile::tempdir().unwrap();
        let torn = run(dir.path(), "torn", &format!("{LOG}{{\"step\":100,\"lo"));
        assert_eq!(log(&torn.join(METRICS)).unwrap().0.len(), 3);
        let broken = run(
            dir.path(),
            "broken",
            &LOG.replacen("\"step\":50", "\"step\":", 1),
        );
        let stem = dir.path().join("chart");
        let drawn = plot(&[torn, broken.clone()], &stem, &OPTIONS).unwrap();
        let path = broken.join(METRICS);
        let note = format!("{}: damaged line 2 skipped", path.display());
        assert_eq!(drawn.notes, [note]);
    }

    #[test]
    fn the_mean_is_geometric_on_a_logarithmic_axis() {
        let points = [(1.0, 100.0), (2.0, 0.0), (3.0, 1.0)];
        let found = smoothed(&points, 0.5, AxisScale::Log);
        // Weights 1/3 and 2/3 on 100 and 1; a loss of 0 does not count.
        assert!((found[2].1 - 100f64.powf(1.0 / 3.0)).abs() < 1e-12);
        assert_eq!(found[1], (2.0, 0.0));
    }

    #[test]
    fn runs_with_and_without_values_are_drawn_together() {
        let dir = tempfile::tempdir().unwrap();
        let first_line = LOG.split_inclusive('\n').next().unwrap();
        let logs = [("full", LOG), ("no-validation", first_line), ("empty", "")];
        let runs: Vec<_> = logs
            .iter()
            .map(|(name, log)| run(dir.path(), name, log))
            .collect();
        let drawn = plot(&runs, &dir.path().join("chart"), &OPTIONS).unwrap();
        let text = fs::read_to_string(drawn.path).unwrap();
        for name in [
            "full",
            "no-validation",
            "empty",
            "training loss",
            "validation SSIM",
            "step",
        ] {
            assert!(text.contains(&format!("\n{name}\n")), "{name}");
        }
        assert!(!text.contains("no data"));
        let error = failure(&runs[2..], &dir.path().join("empty"), &OPTIONS);
        assert!(
            error.ends_with("empty/metrics.jsonl: no values to draw yet"),
            "{error}"
        );
        assert!(!dir.path().join("empty.svg").exists());
    }

    #[test]
    fn invalid_input_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let stem = dir.path().join("chart");
        let none = failure(&[dir.path().join("none")], &stem, &OPTIONS);
        assert!(none.contains("none/metrics.jsonl: cannot read"), "{none}");
        assert_eq!(failure(&[], &stem, &OPTIONS), "no runs to plot");
        for smooth in [-0.1, 1.0, f64::NAN] {
            let options = PlotOptions {
                smooth,
                linear: false,
            };
            let error = failure(&[run(dir.path(), "a", LOG)], &stem, &options);
            assert!(error.starts_with("smoothing: "), "{error}");
        }
    }
}
