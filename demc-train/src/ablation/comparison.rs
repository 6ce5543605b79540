//! Scores of all runs to one row a variant.

use anyhow::ensure;
use demc_infer::evaluate::{ImageScore, Score};
use demc_infer::statistics::Estimate;
use demc_model::metrics::Better;
use serde::{Deserialize, Serialize};

use super::{Finished, Spec};

/// A comparison of variants on the images of the test split.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// The seeds.
    pub seeds: Vec<u64>,
    /// The images.
    pub images: Vec<String>,
    /// A row a variant, the reference first.
    pub rows: Vec<Row>,
    /// What the variants do not have in common but the network.
    pub differences: Vec<String>,
}

/// What is known about a variant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Its name.
    pub name: String,
    /// Base width.
    pub width: usize,
    /// Trainable values.
    pub parameters: u64,
    /// Floating-point operations of a forward pass for each pixel.
    pub flops_per_pixel: f64,
    /// Mean seconds of a run.
    pub seconds: f64,
    /// RelMSE over images and seeds.
    pub relmse: Estimate,
    /// SSIM over the images that have one, and seeds.
    pub ssim: Option<Estimate>,
    /// RelMSE minus that of the first variant, image by image and seed by seed; `None` for the first itself.
    pub relmse_difference: Option<Estimate>,
    /// The same of SSIM.
    pub ssim_difference: Option<Estimate>,
    /// Mean RelMSE of each seed.
    pub relmse_of_seeds: Vec<f64>,
    /// Mean SSIM of each seed.
    pub ssim_of_seeds: Vec<f64>,
}

/// Scores by seed and image.
type Table = Vec<Vec<f64>>;

impl Comparison {
    /// Compares complete runs, `runs[variant][seed]`.
    ///
    /// # Errors
    /// Runs that were not scored on the same images, or on none.
    pub fn new(spec: &Spec, runs: &[Vec<Finished>]) -> anyhow::Result<Self> {
        let names = |run: &Finished| -> Vec<String> {
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
                "{}: scored on other images than {}",
                variant.name,
                spec.variants[0].name
            );
        }
        let tables: Vec<[Table; 2]> = runs.iter().map(|runs| tables(runs)).collect();
        let rows = spec.variants.iter().zip(runs).zip(&tables).enumerate();
        let rows = rows.map(|(i, ((variant, runs), [relmse, ssim]))| {
            let [first_relmse, first_ssim] = &tables[0];
            let difference =
                |a: &Table, b: &Table| (i > 0).then(|| Estimate::of_difference(a, b)).flatten();
            let model = variant.config.model;
            Row {
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
        });
        Ok(Comparison {
            seeds: spec.seeds.clone(),
            images,
            rows: rows.collect(),
            differences: spec.differences(),
        })
    }

    /// What the numbers say, a sentence a variant but the first.
    pub fn verdicts(&self) -> Vec<String> {
        let Some((first, others)) = self.rows.split_first() else {
            return Vec::new();
        };
        let verdict = |row: &Row| {
            let relmse = row
                .relmse_difference
                .map(|found| found.verdict("RelMSE", Better::Lower));
            let ssim = row
                .ssim_difference
                .map(|found| found.verdict("SSIM", Better::Higher));
            let words = [relmse, ssim].into_iter().flatten();
            let words: Vec<String> = words.collect();
            format!("{} against {}: {}", row.name, first.name, words.join("; "))
        };
        others.iter().map(verdict).collect()
    }
}

/// RelMSE and SSIM by seed and image; SSIM of the images that have one.
fn tables(runs: &[Finished]) -> [Table; 2] {
    let table = |of: &dyn Fn(&Score) -> Option<f64>| -> Table {
        let row = |run: &Finished| {
            let scores = run
                .report
                .images
                .iter()
                .map(|image: &ImageScore| of(&image.denoised));
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
