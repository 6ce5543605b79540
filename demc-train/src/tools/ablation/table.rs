//! A comparison as Markdown, CSV and JSON.

use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use demc_program::file::write_whole;

use super::comparison::{Comparison, VariantScores};
use demc_infer::statistics::{Estimate, RESAMPLES};

/// Name of all files, without extension.
const STEM: &str = "ablation";
const MEGAPIXEL: f64 = 1e6;
const GIGA: f64 = 1e9;

/// Markdown, CSV and JSON.
pub(super) fn files(dir: &Path) -> [PathBuf; 3] {
    ["md", "csv", "json"].map(|ending| dir.join(format!("{STEM}.{ending}")))
}

pub(super) fn write(comparison: &Comparison, dir: &Path) -> anyhow::Result<[PathBuf; 3]> {
    std::fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
    let texts = [
        markdown(comparison),
        csv(comparison),
        serde_json::to_string_pretty(comparison)?,
    ];
    let paths = files(dir);
    for (path, text) in paths.iter().zip(texts) {
        write_whole(path, |file| file.write_all(text.as_bytes()))?;
    }
    Ok(paths)
}

pub(super) fn markdown(comparison: &Comparison) -> String {
    let Comparison {
        seeds,
        images,
        rows,
        differences,
    } = comparison;
    let first = rows.first().map_or("", |row| &row.name);
    let mut text = format!(
        "| variant | C | parameters | GFLOP / Mpx | training, min | RelMSE | - {first} | SSIM | - {first} |\n\
         |---|---:|---:|---:|---:|---:|---:|---:|---:|\n"
    );
    for row in rows {
        let _ = writeln!(
            text,
            "| {} | {} | {}{} | {:.0} | {:.1} | {} | {} | {} | {} |",
            row.name,
            row.width,
            row.parameters,
            excess(row, &rows[0]),
            row.flops_per_pixel * MEGAPIXEL / GIGA,
            row.seconds / 60.0,
            mean(Some(row.relmse)),
            difference(row.relmse_difference),
            mean(row.ssim),
            difference(row.ssim_difference),
        );
    }
    let _ = writeln!(
        text,
        "\nMeans over {} test images and {} ({}) with 95 % bootstrap intervals over images and seeds ({RESAMPLES} resamples). \
         Differences are paired by image and seed; bold: the interval excludes 0. RelMSE: Eq. 5, summed over \
         rgb, linear HDR, smaller is better. SSIM: Wang et al. 2004 on clip(x, 0, 1)^(1/2.2), larger is better.\n",
        images.len(),
        count(seeds.len(), "seed"),
        seeds
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
            .join(", "),
    );
    for verdict in comparison.verdicts() {
        let _ = writeln!(text, "- {verdict}.");
    }
    if seeds.len() == 1 {
        text.push_str("- One seed: the intervals do not include the variation between seeds.\n");
    }
    if differences.is_empty() {
        text.push_str(
            "- All variants trained on the same batches in the same order; they differ only in the network.\n",
        )
    } else {
        let _ = writeln!(
            text,
            "- **Not only the network differs:** {}.",
            differences.join("; ")
        );
    }
    text
}

/// ` (+0.3 %)` after a parameter count that differs from that of the first variant.
fn excess(row: &VariantScores, first: &VariantScores) -> String {
    let excess = row.parameters as f64 / first.parameters as f64 - 1.0;
    if row.parameters == first.parameters {
        String::new()
    } else {
        format!(" ({:+.1} %)", 100.0 * excess)
    }
}

fn count(number: usize, what: &str) -> String {
    format!("{number} {what}{}", if number == 1 { "" } else { "s" })
}

fn mean(estimate: Option<Estimate>) -> String {
    estimate.map_or(
        "-".into(),
        |Estimate {
             mean,
             interval: [low, high],
         }| { format!("{mean:.4} ({low:.4} to {high:.4})") },
    )
}

fn difference(estimate: Option<Estimate>) -> String {
    let Some(found) = estimate else {
        return "-".into();
    };
    let [low, high] = found.interval;
    let text = format!("{:+.4}", found.mean);
    let text = if found.is_significant() {
        format!("**{text}**")
    } else {
        text
    };
    format!("{text} ({low:+.4} to {high:+.4})")
}

fn csv(comparison: &Comparison) -> String {
    let estimate = |found: Option<Estimate>| match found {
        Some(Estimate {
            mean,
            interval: [low, high],
        }) => format!("{mean},{low},{high}"),
        None => ",,".into(),
    };
    let heads = ["relmse", "relmse_difference", "ssim", "ssim_difference"]
        .map(|name| format!("{name},{name}_low,{name}_high"));
    let mut text = format!(
        "variant,width,parameters,flops_per_pixel,seconds,{}\n",
        heads.join(",")
    );
    for row in &comparison.rows {
        let estimates = [
            Some(row.relmse),
            row.relmse_difference,
            row.ssim,
            row.ssim_difference,
        ];
        let _ = writeln!(
            text,
            "{},{},{},{},{},{}",
            row.name,
            row.width,
            row.parameters,
            row.flops_per_pixel,
            row.seconds,
            estimates.map(estimate).join(",")
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(name: &str, parameters: u64, difference: Option<Estimate>) -> VariantScores {
        let estimate = |mean: f64| Estimate {
            mean,
            interval: [mean - 0.01, mean + 0.01],
        };
        VariantScores {
            name: name.into(),
            width: 16,
            parameters,
            flops_per_pixel: 125_000.0,
            seconds: 90.0,
            relmse: estimate(0.2),
            ssim: Some(estimate(0.7)),
            relmse_difference: difference,
            ssim_difference: difference.map(|_| estimate(0.001)),
            relmse_of_seeds: vec![0.19, 0.21],
            ssim_of_seeds: vec![0.7, 0.7],
        }
    }

    fn comparison() -> Comparison {
        let worse = Estimate {
            mean: 0.05,
            interval: [0.02, 0.08],
        };
        Comparison {
            seeds: vec![1, 2],
            images: vec!["a".into(), "b".into(), "c".into()],
            rows: vec![row("DEMC", 1000, None), row("SEMC", 1010, Some(worse))],
            differences: Vec::new(),
        }
    }

    #[test]
    fn the_table_marks_significant_differences() {
        let text = markdown(&comparison());
        for words in [
            "| DEMC | 16 | 1000 | 125 | 1.5 | 0.2000 (0.1900 to 0.2100) | - |",
            "| SEMC | 16 | 1010 (+1.0 %) |",
            "**+0.0500** (+0.0200 to +0.0800)",
            "| +0.0010 (-0.0090 to +0.0110) |",
            "3 test images and 2 seeds (1, 2)",
            "- SEMC against DEMC: worse in RelMSE (+0.0500, 95 % +0.0200 to +0.0800); no significant difference in SSIM",
            "All variants trained on the same batches",
        ] {
            assert!(text.contains(words), "{words}:\n{text}");
        }
    }

    #[test]
    fn one_seed_and_other_differences_are_noted() {
        let mut comparison = comparison();
        comparison.seeds = vec![1];
        comparison.differences = vec!["SEMC: train.steps: 3 instead of 4".into()];
        let text = markdown(&comparison);
        assert!(
            text.contains("1 seed (1)") && text.contains("One seed:"),
            "{text}"
        );
        assert!(
            text.contains("Not only the network differs:** SEMC: train.steps: 3"),
            "{text}"
        );
    }

    #[test]
    fn every_row_of_the_csv_has_all_cells() {
        let text = csv(&comparison());
        let cells: Vec<usize> = text.lines().map(|line| line.split(',').count()).collect();
        assert_eq!(cells, [17, 17, 17]);
    }

    #[test]
    fn json_is_read_back() {
        let text = serde_json::to_string(&comparison()).unwrap();
        assert_eq!(
            serde_json::from_str::<Comparison>(&text).unwrap(),
            comparison()
        );
    }
}
