//! The changes of a comparison and their intervals as a chart.

use demc_infer::statistics::{Estimate, Scale};

use crate::tools::chart::figure::{AxisScale, Figure, LinePanel, Series};

use super::comparison::{Comparison, MetricScores, VariantScores};

const PERCENT: f64 = 100.0;

/// A panel for RelMSE, and one for SSIM if the images have one. A line per variant reaches from the
/// lower to the upper end of its interval, with points at both and at the mean.
pub(super) fn figure(comparison: &Comparison) -> Figure {
    let panels = [
        panel(comparison, "change of RelMSE, %", |row| {
            Some(row.relmse.clone())
        }),
        panel(comparison, "change of SSIM", |row| row.ssim.clone()),
    ];
    let has_lines = |panel: &LinePanel| !panel.series.is_empty();
    Figure(panels.into_iter().filter(has_lines).collect())
}

fn panel(
    comparison: &Comparison,
    title: &str,
    scores: impl Fn(&VariantScores) -> Option<MetricScores>,
) -> LinePanel {
    let rows = comparison.rows.iter().enumerate();
    let lines = rows.filter_map(|(number, row)| {
        let change = scores(row)?.change?;
        Some(Series {
            name: row.name.clone(),
            points: points(&change, number as f64),
            faint: false,
            color: number,
        })
    });
    let series = lines.collect();
    let first = comparison.rows.first();
    LinePanel {
        title: title.to_owned(),
        x_label: format!("{title}, with 95 % interval"),
        y_label: "row of the table".to_owned(),
        x: AxisScale::Linear,
        y: AxisScale::Linear,
        series,
        marks: first
            .map(|row| (0.0, row.name.clone()))
            .into_iter()
            .collect(),
    }
}

fn points(change: &Estimate, height: f64) -> Vec<(f64, f64)> {
    let factor = match change.scale {
        Scale::Ratio => PERCENT,
        Scale::Difference => 1.0,
    };
    let [low, high] = change.interval;
    [low, change.mean, high]
        .map(|x| (factor * x, height))
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
        assert_eq!(relmse.marks, [(0.0, "DEMC".to_owned())]);
        let [line] = &relmse.series[..] else {
            panic!("{relmse:?}")
        };
        let change = comparison.rows[1].relmse.change.as_ref().unwrap();
        let xs: Vec<f64> = line.points.iter().map(|point| point.0).collect();
        assert_eq!(
            xs,
            [change.interval[0], change.mean, change.interval[1]].map(|x| 100.0 * x)
        );
        let (x, y) = ssim.series[0].points[1];
        assert!((x - 0.05).abs() < 1e-12 && y == 1.0, "{x} {y}");
    }
}
