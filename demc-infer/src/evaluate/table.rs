//! A report as a Markdown table: one row per image, one column per metric and method.

use std::fmt;

use demc_model::metrics::{METRICS, Metric};
use demc_program::message::{list, printable};

use super::score::{Report, Score, is_headline};

const NONE: &str = "-";

impl Report {
    /// A Markdown table of RelMSE, SSIM and `more` metrics, followed by their definitions.
    pub fn table(&self, more: &[&Metric]) -> String {
        let headlines = METRICS.iter().filter(|metric| is_headline(metric.name));
        let more = more.iter().copied().filter(|m| !is_headline(m.name));
        let metrics: Vec<&Metric> = headlines.chain(more).collect();
        let methods = self.mean.methods();
        let mut rows = vec![head(&metrics, &methods)];
        rows.extend(self.images.iter().map(|image| {
            let residual = image.reference_residual;
            row(&image.name, &metrics, &image.methods(), residual)
        }));
        rows.push(row("mean", &metrics, &methods, None));
        let mut text = format!("{}\n{}", aligned(&rows), legend(&metrics));
        if !self.failed.is_empty() {
            let failed = self.failed.iter().map(|image| printable(&image.name));
            let names = list(&failed.collect::<Vec<_>>());
            text += &format!("\nNot scored, and not part of the means: {names}.");
        }
        text
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.table(&[]))
    }
}

fn label(metric: &Metric) -> &'static str {
    match metric.name {
        "relmse" => "RelMSE",
        "ssim" => "SSIM",
        name => name,
    }
}

/// Only the first column of a metric has its name, so that the table stays narrow.
fn head(metrics: &[&Metric], methods: &[(&str, &Score)]) -> Vec<String> {
    let mut cells = vec!["image".to_owned()];
    for metric in metrics {
        for (i, (name, _)) in methods.iter().enumerate() {
            let name = escaped(name);
            cells.push(match i {
                0 => format!("{} {name}", label(metric)),
                _ => name,
            });
        }
        if metric.name == "relmse" {
            cells.push("reference residual".to_owned());
        }
    }
    cells
}

fn row(
    name: &str,
    metrics: &[&Metric],
    methods: &[(&str, &Score)],
    residual: Option<f64>,
) -> Vec<String> {
    let number = |value: Option<f64>| value.map_or(NONE.into(), |v| format!("{v:.4}"));
    let mut cells = vec![escaped(name)];
    for metric in metrics {
        cells.extend(methods.iter().map(|(_, s)| number(s.get(metric.name))));
        if metric.name == "relmse" {
            cells.push(number(residual));
        }
    }
    cells
}

fn escaped(name: &str) -> String {
    printable(name).replace('|', "\\|")
}

/// Aligned rows with a rule under the first. The first column is left-aligned, the others
/// right-aligned.
/// Largest width of a column that shorter cells are filled up to (ours; names of scenes have no limit).
const MAX_COLUMN: usize = 200;

fn aligned(rows: &[Vec<String>]) -> String {
    let width = |column: usize| rows.iter().map(|r| r[column].chars().count()).max();
    let widths = (0..rows[0].len()).filter_map(width);
    let widths: Vec<usize> = widths.map(|width| width.min(MAX_COLUMN)).collect();
    let dashes = |(i, &width): (usize, &usize)| match i {
        0 => "-".repeat(width),
        _ => "-".repeat(width - 1) + ":",
    };
    let rule: Vec<String> = widths.iter().enumerate().map(dashes).collect();
    let mut out = String::new();
    for cells in rows[..1].iter().chain([&rule]).chain(&rows[1..]) {
        for (i, (cell, width)) in cells.iter().zip(&widths).enumerate() {
            out += &match i {
                0 => format!("| {cell:<width$} |"),
                _ => format!(" {cell:>width$} |"),
            };
        }
        out.push('\n');
    }
    out
}

fn legend(metrics: &[&Metric]) -> String {
    let headlines = "RelMSE: Eq. 5, summed over rgb, linear HDR, smaller is better. \
         SSIM: Wang et al. 2004 on clip(x, 0, 1)^(1/2.2), larger is better.";
    let others = metrics.iter().filter(|metric| !is_headline(metric.name));
    let lines = others.map(|metric| {
        let Metric {
            name, definition, ..
        } = metric;
        format!("\n{name}: {definition}; best {}.", metric.better.phrase())
    });
    headlines.to_owned() + &lines.collect::<String>()
}

#[cfg(test)]
mod tests {
    use demc_model::metrics;

    use super::super::score::FailedImage;
    use super::super::score::tests::image;
    use super::*;

    /// Rust formats at most 65535 columns.
    #[test]
    fn a_very_long_name_is_printed() {
        let name = "x".repeat(70_000);
        let rows = vec![vec!["scene".to_owned()], vec![name.clone()]];
        assert!(aligned(&rows).contains(&name));
    }

    #[test]
    fn the_rows_of_the_table_have_one_width() {
        let report = Report::new(vec![
            image("a", 1.0, None),
            image("a-long-name", 1234.5, Some(0.5)),
        ]);
        let table = report.to_string();
        let lines: Vec<_> = table
            .lines()
            .take_while(|line| line.starts_with('|'))
            .collect();
        assert_eq!(lines.len(), 5);
        assert!(
            lines.iter().all(|line| line.len() == lines[0].len()),
            "{table}"
        );
        assert!(lines[4].starts_with("| mean "), "{table}");
    }

    #[test]
    fn images_without_scores_are_named_below_the_table() {
        let mut report = Report::new(vec![image("a", 1.0, None)]);
        assert!(!report.to_string().contains("Not scored"));
        report.failed = ["b", "c\n"].map(failed).into();
        let table = report.to_string();
        let end = "\nNot scored, and not part of the means: b, c\\n.";
        assert!(table.ends_with(end), "{table}");
    }

    fn failed(name: &str) -> FailedImage {
        FailedImage {
            name: name.into(),
            error: "damaged".into(),
        }
    }

    #[test]
    fn columns_are_added_for_metrics_and_baselines() {
        let mut score = image("a|b", 1.0, Some(0.5));
        score.baselines.insert("other".into(), score.noisy.clone());
        let smape = metrics::find("smape").expect("a row");
        let table = Report::new(vec![score]).table(&[smape]);
        let head = table.lines().next().expect("a head");
        let cells: Vec<_> = head.split('|').map(str::trim).collect();
        assert_eq!(
            cells[1..],
            [
                "image",
                "RelMSE noisy",
                "black",
                "other",
                "denoised",
                "reference residual",
                "SSIM noisy",
                "black",
                "other",
                "denoised",
                "smape noisy",
                "black",
                "other",
                "denoised",
                "",
            ]
        );
        assert!(table.contains("| a\\|b  |"), "{table}");
        assert!(table.contains("\nsmape: mean over values"), "{table}");
    }
}
