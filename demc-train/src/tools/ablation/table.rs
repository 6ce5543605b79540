//! A comparison as Markdown, JSON, and a figure.

use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use demc_program::file::{read_text, write_whole};

use super::comparison::{Comparison, MetricScores, VariantScores};
use super::figure;
use demc_infer::statistics::{Estimate, FEWEST_BASES, RESAMPLES};

/// The start of every table.
const START: &str = "| variant |";
/// Largest table that is read, in bytes (ours).
const MAX_TABLE: u64 = 1 << 24;
const MEGAPIXEL: f64 = 1e6;
const GIGA: f64 = 1e9;

/// Markdown, JSON, changes, and bars.
pub(super) fn files(dir: &Path) -> [PathBuf; 4] {
    ["ablation.md", "ablation.json", "ablation.svg", "bars.svg"].map(|name| dir.join(name))
}

/// Checks that the table in `dir`, if there is one, is of this program.
///
/// # Errors
/// One of another program.
pub(super) fn check_own(dir: &Path) -> anyhow::Result<()> {
    let [table, ..] = files(dir);
    let Ok(text) = read_text(&table, MAX_TABLE) else {
        return Ok(());
    };
    ensure!(
        text.starts_with(START),
        "{}: not written by ablate, which would replace it; move it",
        table.display()
    );
    Ok(())
}

pub(super) fn write(comparison: &Comparison, dir: &Path) -> anyhow::Result<[PathBuf; 4]> {
    let [table, numbers, changed, compared] = files(dir);
    let json = serde_json::to_string_pretty(comparison)? + "\n";
    for (path, text) in [(&table, markdown(comparison)), (&numbers, json)] {
        write_whole(path, |file| file.write_all(text.as_bytes()))?;
    }
    for (path, figure) in [
        (&changed, figure::changes(comparison)),
        (&compared, figure::bars(comparison)),
    ] {
        figure
            .write(path)
            .with_context(|| path.display().to_string())?;
    }
    Ok([table, numbers, changed, compared])
}

pub(super) fn markdown(comparison: &Comparison) -> String {
    let Comparison {
        seeds,
        rows,
        differences,
        ..
    } = comparison;
    let first = rows.first().map_or("", |row| &row.name);
    let mut text = format!(
        "{START} C | parameters | GFLOP / Mpx | training, min | RelMSE | against {first} | detectable | SSIM | against {first} | detectable |\n\
         |---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n"
    );
    for row in rows {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} |",
            row.name,
            costs(row, &rows[0]),
            cells(Some(&row.relmse)),
            cells(row.ssim.as_ref()),
        );
    }
    text.push('\n');
    for line in explanation(comparison)
        .into_iter()
        .chain(comparison.verdicts())
    {
        let _ = writeln!(text, "- {line}.");
    }
    if comparison.base_count() < FEWEST_BASES {
        let _ = writeln!(
            text,
            "- Fewer than {FEWEST_BASES} base scenes cannot show a difference."
        );
    }
    for row in rows.iter().filter(|row| row.seeds.len() < seeds.len()) {
        let seeds = count(row.seeds.len(), "seed");
        let _ = writeln!(
            text,
            "- {}: {seeds} only, compared with the same seeds of {first}.",
            row.name
        );
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

/// What the numbers of the table are.
fn explanation(comparison: &Comparison) -> [String; 7] {
    let seeds = &comparison.seeds;
    let listed: Vec<String> = seeds.iter().map(ToString::to_string).collect();
    let over = if seeds.len() == 1 {
        "base scenes"
    } else {
        "base scenes and seeds"
    };
    [
        format!(
            "Geometric mean of RelMSE, mean of SSIM: {} test images of {}, {} ({})",
            comparison.images.len(),
            count(comparison.base_count(), "base scene"),
            count(seeds.len(), "seed"),
            listed.join(", "),
        ),
        "Each base scene counts once. Changes are paired by image and seed".into(),
        format!(
            "In brackets: 95 % bootstrap interval over {over} ({RESAMPLES} resamples, BCa), no narrower than a t interval"
        ),
        "Bold: a claimed difference. Bootstrap and sign-flip test agree at 5 % after Holm's correction"
            .into(),
        "Detectable: smallest change that would be found with a probability of 80 %, before this correction"
            .into(),
        "RelMSE: Eq. 5, summed over rgb, linear HDR, smaller is better".into(),
        "SSIM: Wang et al. 2004 on clip(x, 0, 1)^(1/2.2), larger is better".into(),
    ]
}

/// Width, parameters, operations, and training time of a network.
fn costs(row: &VariantScores, first: &VariantScores) -> String {
    if row.width == 0 {
        return "- | - | - | -".into();
    }
    format!(
        "{} | {}{} | {:.0} | {:.1}",
        row.width,
        row.parameters,
        excess(row, first),
        row.flops_per_pixel * MEGAPIXEL / GIGA,
        row.minutes,
    )
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

/// Mean, change, and smallest detectable change.
fn cells(scores: Option<&MetricScores>) -> String {
    let Some(MetricScores { average, change }) = scores else {
        return "- | - | -".into();
    };
    let mean = format!("{:.4}", average.mean);
    match change {
        None => format!("{mean} | - | -"),
        Some(found) => format!("{mean} | {} | {}", text(found), found.detectable_text()),
    }
}

fn text(found: &Estimate) -> String {
    let mean = found.scale.text(found.mean);
    let mean = if found.is_claimed() {
        format!("**{mean}**")
    } else {
        mean
    };
    format!("{mean} ({})", found.interval_text())
}

#[cfg(test)]
mod tests {
    use super::super::results::tests::scored;
    use super::*;

    /// Seven base scenes of one image: SEMC has twice the RelMSE and a mixed SSIM.
    fn comparison(seeds: &[u64]) -> Comparison {
        let scenes = ["a", "b", "c", "d", "e", "f", "g"];
        let demc = scenes.map(|name| (name, 0.2, 0.7));
        let semc = scenes.map(|name| (name, 0.4, if name < "d" { 0.71 } else { 0.69 }));
        let mut runs = Vec::new();
        for (variant, scores) in [("DEMC", demc), ("SEMC", semc)] {
            runs.extend(seeds.iter().map(|seed| scored(variant, *seed, &scores)));
        }
        for run in &mut runs[seeds.len()..] {
            run.parameters = 1010;
        }
        Comparison::new(&runs).unwrap()
    }

    #[test]
    fn the_table_marks_claimed_differences() {
        let text = markdown(&comparison(&[1, 2]));
        for words in [
            "| DEMC | 16 | 1000 | 125 | 1.5 | 0.2000 | - | - | 0.7000 | - | - |",
            "| SEMC | 16 | 1010 (+1.0 %) |",
            "| **+100.0 %** (+100.0 % to +100.0 %) | 0.0 % | 0.6986 | -0.0014 (",
            "7 test images of 7 base scenes, 2 seeds (1, 2).",
            "- SEMC against DEMC: worse in RelMSE (+100.0 %, 95 % interval +100.0 % to +100.0 %, p = 0.016).\n",
            "- SEMC against DEMC: no difference shown in SSIM (-0.0014",
            "All variants trained on the same batches",
        ] {
            assert!(text.contains(words), "{words}:\n{text}");
        }
        assert!(!text.contains("Fewer than"), "{text}");
    }

    #[test]
    fn one_seed_and_other_differences_are_noted() {
        let mut comparison = comparison(&[1]);
        comparison.differences = vec!["SEMC: train.steps: 3 instead of 4".into()];
        let text = markdown(&comparison);
        for words in [
            "1 seed (1)",
            "One seed:",
            "- SEMC against DEMC, for this one seed: worse in RelMSE",
            "Not only the network differs:** SEMC: train.steps: 3",
        ] {
            assert!(text.contains(words), "{words}:\n{text}");
        }
    }

    #[test]
    fn json_is_read_back() {
        let comparison = comparison(&[1, 2]);
        let text = serde_json::to_string(&comparison).unwrap();
        assert_eq!(
            serde_json::from_str::<Comparison>(&text).unwrap(),
            comparison
        );
    }
}
