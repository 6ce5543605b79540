//! The scores of all runs, summarised in one row per variant.

use std::collections::BTreeSet;

use anyhow::{Context, ensure};
use demc_infer::statistics::{Average, Estimate, holm};
use demc_model::metrics::{Better, METRICS, Metric};
use serde::{Deserialize, Serialize};

use super::results::ScoredRun;

/// A comparison of variants on the images of the test split.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// The seeds from which the reference was trained.
    pub seeds: Vec<u64>,
    /// The images.
    pub images: Vec<String>,
    /// The base scene of each image.
    pub bases: Vec<String>,
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
    /// The seeds by which it is compared.
    pub seeds: Vec<u64>,
    /// Base width; 0 for a method without training.
    pub width: usize,
    /// Number of trainable parameters.
    pub parameters: u64,
    /// Floating-point operations of a forward pass per pixel.
    pub flops_per_pixel: f64,
    /// Mean training time of a run, minutes.
    pub minutes: f64,
    /// RelMSE.
    pub relmse: MetricScores,
    /// SSIM over the images that have one.
    pub ssim: Option<MetricScores>,
}

/// The scores of a variant in one metric.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MetricScores {
    /// The mean.
    #[serde(flatten)]
    pub average: Average,
    /// The change from the first variant to this one; `None` for the first, and for fewer than two
    /// base scenes.
    pub change: Option<Estimate>,
}

/// The values of a metric: `values[variant][seed][image]`, for the images that have one.
struct MetricTable<'a> {
    values: Vec<Vec<Vec<f64>>>,
    bases: Vec<&'a str>,
}

impl Comparison {
    /// Compares runs. The first run is of the reference. A variant is compared by the seeds from which
    /// the reference was trained, too.
    ///
    /// # Errors
    /// No such seed; two runs of the same variant and seed; scores of different images.
    pub fn new(runs: &[ScoredRun]) -> anyhow::Result<Self> {
        let first = runs.first().context("no scores to compare")?;
        let mut variants: Vec<&str> = Vec::new();
        for run in runs {
            if !variants.contains(&&*run.variant) {
                variants.push(&run.variant);
            }
        }
        let of_reference = seeds_of(runs, &first.variant);
        let runs_of = |variant: &&str| -> anyhow::Result<Vec<&ScoredRun>> {
            let seeds = &seeds_of(runs, variant) & &of_reference;
            ensure!(
                !seeds.is_empty(),
                "no seed from which both {} and {variant} were trained",
                first.variant
            );
            let selected = |run: &&ScoredRun| run.variant == *variant && seeds.contains(&run.seed);
            let mut selected: Vec<_> = runs.iter().filter(selected).collect();
            selected.sort_by_key(|run| run.seed);
            ensure!(
                selected.len() == seeds.len(),
                "{variant}: two runs of the same seed"
            );
            Ok(selected)
        };
        let selected: Vec<Vec<&ScoredRun>> =
            variants.iter().map(runs_of).collect::<Result<_, _>>()?;
        let relmse = scores(&selected, &METRICS[0])?.context("no RelMSE to compare")?;
        let ssim = scores(&selected, &METRICS[1])?;
        let mut ssim = ssim.into_iter().flatten();
        let rows = selected
            .iter()
            .zip(relmse)
            .map(|(runs, relmse)| VariantScores {
                name: runs[0].variant.clone(),
                seeds: runs.iter().map(|run| run.seed).collect(),
                width: runs[0].width,
                parameters: runs[0].parameters,
                flops_per_pixel: runs[0].flops_per_pixel,
                minutes: runs.iter().map(|run| run.minutes).sum::<f64>() / runs.len() as f64,
                relmse,
                ssim: ssim.next(),
            });
        let rows = rows.collect();
        let (images, bases) = images(first, METRICS[0].name).into_iter().unzip();
        let settings = selected.iter().map(|runs| runs[0]);
        let differing = settings.filter(|run| !run.settings.is_empty());
        Ok(Comparison {
            seeds: of_reference.into_iter().collect(),
            images,
            bases,
            rows,
            differences: differing
                .map(|run| format!("{}: {}", run.variant, run.settings))
                .collect(),
        })
    }

    /// Number of base scenes.
    pub fn base_count(&self) -> usize {
        self.bases.iter().collect::<BTreeSet<_>>().len()
    }

    /// A sentence for each variant except the first and each metric: whether it is better or worse.
    pub fn verdicts(&self) -> Vec<String> {
        let Some((first, others)) = self.rows.split_first() else {
            return Vec::new();
        };
        let verdicts = others.iter().flat_map(|row| {
            let scope = if row.seeds.len() == 1 {
                ", for this one seed"
            } else {
                ""
            };
            let metrics = [
                ("RelMSE", Better::Lower, Some(&row.relmse)),
                ("SSIM", Better::Higher, row.ssim.as_ref()),
            ];
            metrics
                .into_iter()
                .filter_map(move |(name, better, scores)| {
                    let verdict = match &scores?.change {
                        Some(change) => change.verdict(name, better),
                        None => format!("one base scene gives no interval of {name}"),
                    };
                    Some(format!(
                        "{} against {}{scope}: {verdict}",
                        row.name, first.name
                    ))
                })
        });
        verdicts.collect()
    }
}

/// The scores of each variant in `metric`; `None` if no image has a value.
///
/// # Errors
/// Values of different images.
fn scores(runs: &[Vec<&ScoredRun>], metric: &Metric) -> anyhow::Result<Option<Vec<MetricScores>>> {
    let MetricTable { values, bases } = table(runs, metric.name)?;
    let seeds_of = |runs: &[&ScoredRun]| -> Vec<u64> { runs.iter().map(|run| run.seed).collect() };
    let reference = seeds_of(&runs[0]);
    let compare = |(ours, runs): (&Vec<Vec<f64>>, &Vec<&ScoredRun>)| {
        let average = Average::of(metric.better, ours, &bases)?;
        let seeds = seeds_of(runs);
        let paired = reference.iter().zip(&values[0]);
        let theirs: Vec<Vec<f64>> = paired
            .filter(|(seed, _)| seeds.contains(seed))
            .map(|(_, values)| values.clone())
            .collect();
        let change = Estimate::compare(metric.better, ours, &theirs, &bases);
        Some(MetricScores { average, change })
    };
    let mut found: Option<Vec<MetricScores>> = values.iter().zip(runs).map(compare).collect();
    if let Some([first, others @ ..]) = found.as_deref_mut() {
        first.change = None;
        holm(others.iter_mut().filter_map(|row| row.change.as_mut()));
    }
    Ok(found)
}

/// The values of `metric` by variant, seed, and image.
///
/// # Errors
/// Values of different images.
fn table<'a>(runs: &[Vec<&'a ScoredRun>], metric: &str) -> anyhow::Result<MetricTable<'a>> {
    let reference = runs[0][0];
    let expected = images(reference, metric);
    let row = |run: &&ScoredRun| -> anyhow::Result<Vec<f64>> {
        ensure!(
            images(run, metric) == expected,
            "{}, seed {}: {metric} of different images than {}, seed {}",
            run.variant,
            run.seed,
            reference.variant,
            reference.seed
        );
        let scores = run.scores.iter().filter(|score| score.metric == metric);
        Ok(scores.map(|score| score.value).collect())
    };
    let values = runs.iter().map(|runs| runs.iter().map(row).collect());
    let scores = reference.scores.iter();
    Ok(MetricTable {
        values: values.collect::<Result<_, _>>()?,
        bases: scores
            .filter(|score| score.metric == metric)
            .map(|score| &*score.base)
            .collect(),
    })
}

fn seeds_of(runs: &[ScoredRun], variant: &str) -> BTreeSet<u64> {
    let runs = runs.iter().filter(|run| run.variant == variant);
    runs.map(|run| run.seed).collect()
}

/// The images with a value of `metric`, and their base scenes.
fn images(run: &ScoredRun, metric: &str) -> Vec<(String, String)> {
    let scores = run.scores.iter().filter(|score| score.metric == metric);
    scores
        .map(|score| (score.image.clone(), score.base.clone()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::results::tests::scored;
    use super::*;

    const DEMC: [(&str, f64, f64); 3] = [("a1", 1.0, 0.5), ("a2", 4.0, 0.7), ("b1", 8.0, 0.9)];

    fn runs() -> Vec<ScoredRun> {
        let half = DEMC.map(|(image, relmse, ssim)| (image, relmse / 2.0, ssim + 0.01));
        vec![
            scored("DEMC", 1, &DEMC),
            scored("DEMC", 2, &DEMC),
            scored("SEMC", 1, &half),
            scored("SEMC", 2, &half),
        ]
    }

    #[test]
    fn variants_are_compared_by_image_seed_and_base_scene() {
        let found = Comparison::new(&runs()).unwrap();
        assert_eq!(
            (found.seeds.len(), found.images.len(), found.base_count()),
            (2, 3, 2)
        );
        let [demc, semc] = &found.rows[..] else {
            panic!("{found:?}")
        };
        assert!((demc.relmse.average.mean - 4.0).abs() < 1e-12);
        assert_eq!(demc.relmse.change, None);
        let change = semc.relmse.change.as_ref().unwrap();
        assert!((change.mean + 0.5).abs() < 1e-12, "{change:?}");
        let ssim = semc.ssim.as_ref().unwrap().change.as_ref().unwrap();
        assert!((ssim.mean - 0.01).abs() < 1e-12, "{ssim:?}");
        let sentence = &found.verdicts()[0];
        assert!(
            sentence.starts_with("SEMC against DEMC: no difference shown in RelMSE (-50.0 %"),
            "{sentence}"
        );
    }

    /// The second seed of DEMC has twice the error, and no part in the comparison with SEMC.
    #[test]
    fn a_change_is_paired_by_seed() {
        let mut runs = runs();
        runs[1]
            .scores
            .iter_mut()
            .for_each(|score| score.value *= 2.0);
        let found = Comparison::new(&runs[..3]).unwrap();
        let change = found.rows[1].relmse.change.as_ref().unwrap();
        assert!((change.mean + 0.5).abs() < 1e-12, "{change:?}");
        assert_eq!(found.rows[0].relmse.average.of_seeds.len(), 2);
    }

    #[test]
    fn only_seeds_of_both_variants_count_and_one_is_named() {
        let found = Comparison::new(&runs()[..3]).unwrap();
        assert_eq!(found.seeds, [1, 2]);
        assert_eq!(found.rows[1].seeds, [1]);
        let sentence = &found.verdicts()[0];
        assert!(
            sentence.starts_with("SEMC against DEMC, for this one seed: "),
            "{sentence}"
        );
        let error = |runs: &[ScoredRun]| Comparison::new(runs).unwrap_err().to_string();
        let other_seed = scored("SEMC", 3, &DEMC);
        let error_of_seed = error(&[runs().remove(0), other_seed]);
        assert!(error_of_seed.contains("no seed"), "{error_of_seed}");
        let fewer = scored("SEMC", 1, &DEMC[..2]);
        let error_of_images = error(&[runs().remove(0), fewer]);
        assert!(
            error_of_images.contains("SEMC, seed 1: relmse of different images than DEMC, seed 1"),
            "{error_of_images}"
        );
        let twice = [runs().remove(0), runs().remove(0), runs().remove(2)];
        assert!(error(&twice).contains("DEMC: two runs of the same seed"));
        assert!(error(&[]).contains("no scores"));
    }
}
