//! The values of a comparison and their changes as charts.

use demc_infer::statistics::Scale;

use crate::tools::chart::figure::{AxisScale, Category, CategoryFigure, CategoryPanel};

use super::comparison::{Comparison, MetricScores, VariantScores};

type ScoresOf = fn(&VariantScores) -> Option<&MetricScores>;

/// The metrics of the charts.
const METRICS: [(&str, ScoresOf); 2] = [
    ("RelMSE", |row| Some(&row.relmse)),
    ("SSIM", |row| row.ssim.as_ref()),
];

/// The mean of each variant as a bar (Fig. 10), in a panel for each metric.
pub(super) fn bars(comparison: &Comparison) -> CategoryFigure {
    let panels = METRICS.into_iter().filter_map(|(metric, scores)| {
        let rows: Vec<Category> = categories(comparison, scores, |scores| {
            Some((scores.average.mean, scores.average.interval))
        });
        (!rows.is_empty()).then(|| CategoryPanel {
            title: format!("{metric}, 95 % intervals"),
            x_label: match metric {
                "RelMSE" => "geometric mean, smaller is better",
                _ => "mean, larger is better",
            }
            .to_owned(),
            x: AxisScale::Linear,
            bars: true,
            rows,
            line: None,
        })
    });
    CategoryFigure(panels.collect())
}

/// The change of each variant with its interval, in a panel for each metric.
pub(super) fn changes(comparison: &Comparison) -> CategoryFigure {
    let first = &comparison.rows[0].name;
    let panels = METRICS.into_iter().filter_map(|(metric, scores)| {
        let mut others = comparison.rows.iter().filter_map(scores);
        let scale = others.find_map(|scores| Some(scores.change.as_ref()?.scale))?;
        let (x, equal, between) = match scale {
            Scale::Ratio => (AxisScale::Log, 1.0, "/"),
            Scale::Difference => (AxisScale::Linear, 0.0, "-"),
        };
        let rows = categories(comparison, scores, |scores| {
            let change = scores.change.as_ref()?;
            let interval = change.interval.map(|end| equal + end);
            Some((equal + change.mean, Some(interval)))
        });
        Some(CategoryPanel {
            title: format!("{metric}, 95 % intervals"),
            x_label: format!("{metric} {between} {metric} of {first}"),
            x,
            bars: false,
            rows,
            line: Some(equal),
        })
    });
    CategoryFigure(panels.collect())
}

/// A category for each variant that has a value.
fn categories(
    comparison: &Comparison,
    scores: impl Fn(&VariantScores) -> Option<&MetricScores>,
    value: impl Fn(&MetricScores) -> Option<(f64, Option<[f64; 2]>)>,
) -> Vec<Category> {
    let rows = comparison.rows.iter().enumerate();
    let categories = rows.filter_map(|(color, row)| {
        let (value, interval) = value(scores(row)?)?;
        Some(Category {
            name: row.name.clone(),
            value,
            interval,
            color,
        })
    });
    categories.collect()
}

#[cfg(test)]
mod tests {
    use super::super::results::tests::scored;
    use super::*;

    #[test]
    fn charts_have_the_values_of_the_comparison() {
        let demc = [("a", 1.0, 0.5), ("b", 4.0, 0.7)];
        let semc = [("a", 2.0, 0.5), ("b", 4.0, 0.8)];
        let runs = [scored("DEMC", 1, &demc), scored("SEMC", 1, &semc)];
        let comparison = Comparison::new(&runs).unwrap();
        let CategoryFigure(panels) = changes(&comparison);
        let [relmse, ssim] = &panels[..] else {
            panic!("{panels:?}")
        };
        assert_eq!(relmse.line, Some(1.0));
        let [row] = &relmse.rows[..] else {
            panic!("{relmse:?}")
        };
        let change = comparison.rows[1].relmse.change.as_ref().unwrap();
        assert_eq!((row.name.as_str(), row.color), ("SEMC", 1));
        assert_eq!(row.value, 1.0 + change.mean);
        assert_eq!(row.interval, Some(change.interval.map(|end| 1.0 + end)));
        assert!((ssim.rows[0].value - 0.05).abs() < 1e-12, "{ssim:?}");

        let CategoryFigure(panels) = bars(&comparison);
        let names: Vec<&str> = panels[0].rows.iter().map(|row| row.name.as_str()).collect();
        assert_eq!(names, ["DEMC", "SEMC"]);
        assert_eq!(panels[0].rows[0].value, 2.0);
        let [low, high] = panels[0].rows[0].interval.unwrap();
        assert!(low < 2.0 && high > 2.0, "{low} {high}");
    }
}
