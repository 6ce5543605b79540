//! The scores of all runs, summarised in one row per variant.

use anyhow::ensure;
use demc_infer::evaluate::{ImageScore, Report, Score};
use demc_infer::statistics::Estimate;
use demc_model::metrics::Better;
use serde::{Deserialize, Serialize};

use super::spec::AblationSpec;

/// A comparison of variants on the images of the test split.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// The seeds.
    pub seeds: Vec<u64>,
    /// The images.
    pub images: Vec<String>,
    /// One row per variant, the reference first.
    pub rows: Vec<VariantScores>,
    /// Keys outside `[model]` in which the variants differ.
    pub differences: Vec<String>,
}

/// The scores and costs of a variant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VariantScores {
    /// Its name.
    pub name: String,
    /// Base width.
    pub width: usize,
    /// Number of trainable parameters.
    pub parameters: u64,
    /// Floating-point operations of a forward pass per pixel.
    pub flops_per_pixel: f64,
    /// Mean training time of a run, seconds.
    pub seconds: f64,
    /// RelMSE over images and seeds.
    pub relmse: Estimate,
    /// SSIM over the images that have one, and seeds.
    pub ssim: Option<Estimate>,
    /// RelMSE minus that of the first variant, paired by image and seed; `None` for the first.
    pub relmse_difference: Option<Estimate>,
    /// SSIM minus that of the first variant.
    pub ssim_difference: Option<Estimate>,
    /// Mean RelMSE of each seed.
    pub relmse_of_seeds: Vec<f64>,
    /// Mean SSIM of each seed.
    pub ssim_of_seeds: Vec<f64>,
}

/// A complete run.
#[derive(Clone, Debug)]
pub struct FinishedRun {
    /// Scores of the test split.
    pub report: Report,
    /// Training time, seconds.
    pub seconds: f64,
}

type ScoreTable = Vec<Vec<f64>>;

impl Comparison {
    /// Compares complete runs, `runs[variant][seed]`.
    ///
    /// # Errors
    /// Runs without scores, or with scores on different images.
    pub fn new(spec: &AblationSpec, runs: &[Vec<FinishedRun>]) -> anyhow::Result<Self> {
        let names = |run: &FinishedRun| -> Vec<String> {
            run.report
                .images
                .iter()
                .map(|image| image.name.clone())
                .collect()
        };
        let images = runs
            .first()
            .and_then(|runs| runs.first())
            .map(names)
            .unwrap_or_default();
        ensure!(
            !images.is_empty(),
            "{}: no scores to compare",
            spec.dir.display()
        );
        for (variant, runs) in spec.variants.iter().zip(runs) {
            ensure!(
                runs.iter().all(|run| names(run) == images),
                "{}: scored on different images than {}",
                variant.name,
                spec.variants[0].name
            );
        }
        let tables: Vec<[ScoreTable; 2]> = runs.iter().map(|runs| tables(runs)).collect();
        let rows = spec.variants.iter().zip(runs).zip(&tables).enumerate().map(
            |(i, ((variant, runs), [relmse, ssim]))| {
                let [first_relmse, first_ssim] = &tables[0];
                let difference = |a: &ScoreTable, b: &ScoreTable| {
                    (i > 0).then(|| Estimate::of_difference(a, b)).flatten()
                };
                let model = variant.config.model;
                VariantScores {
                    name: variant.name.clone(),
                    width: model.width,
                    parameters: model.parameter_count(),
                    flops_per_pixel: model.flops_per_pixel(),
                    seconds: mean(runs.iter().map(|run| run.seconds)),
                    relmse: Estimate::of(relmse).expect("there are images"),
                    ssim: Estimate::of(ssim),
                    relmse_difference: difference(relmse, first_relmse),
                    ssim_difference: difference(ssim, first_ssim),
                    relmse_of_seeds: relmse.iter().map(|row| mean(row.iter().copied())).collect(),
                    ssim_of_seeds: ssim.iter().map(|row| mean(row.iter().copied())).collect(),
                }
            },
        );
        Ok(Comparison {
            seeds: spec.seeds.clone(),
            images,
            rows: rows.collect(),
            differences: spec.differences(),
        })
    }

    /// One sentence for each variant except the first: whether it is better or worse.
    pub fn verdicts(&self) -> Vec<String> {
        let Some((first, others)) = self.rows.split_first() else {
            return Vec::new();
        };
        let verdict = |row: &VariantScores| {
            let relmse = row
                .relmse_difference
                .map(|found| found.verdict("RelMSE", Better::Lower));
            let ssim = row
                .ssim_difference
                .map(|found| found.verdict("SSIM", Better::Higher));
            let words: Vec<String> = [relmse, ssim].into_iter().flatten().collect();
            format!("{} against {}: {}", row.name, first.name, words.join("; "))
        };
        others.iter().map(verdict).collect()
    }
}

/// RelMSE and SSIM by seed and image; only images with an SSIM count.
fn tables(runs: &[FinishedRun]) -> [ScoreTable; 2] {
    let table = |metric: &dyn Fn(&Score) -> Option<f64>| -> ScoreTable {
        let row = |run: &FinishedRun| {
            let scores = run
                .report
                .images
                .iter()
                .map(|image: &ImageScore| metric(&image.denoised));
            scores.flatten().collect()
        };
        runs.iter().map(row).collect()
    };
    [
        table(&|score| Some(score.relmse)),
        table(&|score| score.ssim),
    ]
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (count, sum) = values.fold((0.0, 0.0), |(n, sum), value| (n + 1.0, sum + value));
    sum / count
}
