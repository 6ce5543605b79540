//! The changes of a comparison and their intervals as a chart.

use demc_infer::statistics::{Estimate, Scale};

use crate::tools::chart::figure::{AxisScale, Figure, LinePanel, Series};

use super::comparison::{Comparison, MetricScores, VariantScores};

/// A panel for RelMSE, and one for SSIM if the images have one. A line per variant reaches from the
/// lower to the upper end of its interval, with points at both and at the mean.
pub(super) fn figure(comparison: &Comparison) -> Figure {
    let panels = [
        panel(comparison, "RelMSE", |row| Some(row.relmse.clone())),
        panel(comparison, "SSIM", |row| row.ssim.clone()),
    ];
    Figure(panels.into_iter().flatten().collect())
}

/// `None` without an interval.
fn panel(
    comparison: &Comparison,
    metric: &str,
    scores: impl Fn(&VariantScores) -> Option<MetricScores>,
) -> Option<LinePanel> {
    let changes = comparison
        .rows
        .iter()
        .enumerate()
        .filter_map(|(number, row)| {
            let change = scores(row)?.change?;
            Some((number, row, change))
        });
    let changes: Vec<_> = changes.collect();
    let scale = changes.first()?.2.scale;
    let first = &comparison.rows[0].name;
    let (x, equal, x_label) = match scale {
        Scale::Ratio => (
            AxisScale::Log,
            1.0,
            format!("{metric} / {metric} of {first}"),
        ),
        Scale::Difference => (
            AxisScale::Linear,
            0.0,
            format!("{metric} - {metric} of {first}"),
        ),
    };
    let series = changes.iter().map(|(number, row, change)| Series {
        name: row.name.clone(),
        points: points(change, equal, *number as f64),
        faint: false,
        color: *number,
    });
    Some(LinePanel {
        title: format!("{metric}, 95 % intervals"),
        x_label,
        y_label: "variant".to_owned(),
        x,
        y: AxisScale::Linear,
        series: series.collect(),
        marks: vec![(equal, first.clone())],
    })
}

/// Both ends and the mean, relative to `equal`.
fn points(change: &Estimate, equal: f64, height: f64) -> Vec<(f64, f64)> {
    let [low, high] = change.interval;
    [low, change.mean, high]
        .map(|x| (equal + x, height))
        .to_vec()
}

#[cfg(test)]
mod tests {
    use super::super::results::tests::scored;
    use super::*;

    #[test]
    fn a_line_reaches_over_the_interval_of_a_variant() {
        let demc = [("a", 1.0, 0.5), ("b", 4.0, 0.7)];
        let semc = [("a", 2.0, 0.5), ("b", 4.0, 0.8)];
        let runs = [scored("DEMC", 1, &demc), scored("SEMC", 1, &semc)];
        let comparison = Comparison::new(&runs).unwrap();
        let Figure(panels) = figure(&comparison);
        let [relmse, ssim] = &panels[..] else {
            panic!("{panels:?}")
        };
        assert_eq!(relmse.marks, [(1.0, "DEMC".to_owned())]);
        let [line] = &relmse.series[..] else {
            panic!("{relmse:?}")
        };
        let change = comparison.rows[1].relmse.change.as_ref().unwrap();
        let xs: Vec<f64> = line.points.iter().map(|point| point.0).collect();
        let [low, high] = change.interval;
        assert_eq!(xs, [low, change.mean, high].map(|x| 1.0 + x));
        let (x, y) = ssim.series[0].points[1];
        assert!((x - 0.05).abs() < 1e-12 && y == 1.0, "{x} {y}");
    }
}
