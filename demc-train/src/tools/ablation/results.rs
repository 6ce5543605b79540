//! `results.csv`: one row per variant, seed, image, and metric. Every table and figure of an ablation
//! can be made from it again.

use std::io::Write;
use std::path::Path;

use anyhow::{Context, ensure};
use demc_program::file::{read_text, write_whole};

/// Name of the file.
pub const RESULTS: &str = "results.csv";
/// Largest file that is read, in bytes (ours: a row takes about 100).
const MAX_RESULTS: u64 = 1 << 28;
const HEADER: [&str; 14] = [
    "variant",
    "seed",
    "image",
    "base",
    "metric",
    "value",
    "configuration",
    "weights",
    "steps",
    "minutes",
    "width",
    "parameters",
    "flops_per_pixel",
    "settings",
];

/// A run of a variant from a seed: what its rows have in common.
#[derive(Clone, Debug, PartialEq)]
pub struct ScoredRun {
    /// Name of the variant.
    pub variant: String,
    /// Seed of the training.
    pub seed: u64,
    /// [`Config::hash`](crate::config::Config::hash); empty if unknown.
    pub configuration: String,
    /// First digits of the SHA-256 of the file of weights; empty if unknown.
    pub weights: String,
    /// Training steps.
    pub steps: u64,
    /// Training time, minutes.
    pub minutes: f64,
    /// Base width.
    pub width: usize,
    /// Number of trainable parameters.
    pub parameters: u64,
    /// Floating-point operations of a forward pass per pixel.
    pub flops_per_pixel: f64,
    /// Keys outside `[model]` in which the variant differs from the first one.
    pub settings: String,
    /// The scores, by image and metric.
    pub scores: Vec<ImageValue>,
}

/// The value of a metric on an image.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageValue {
    /// The image.
    pub image: String,
    /// Its base scene.
    pub base: String,
    /// Name of the metric.
    pub metric: String,
    /// The value.
    pub value: f64,
}

impl ScoredRun {
    fn rows(&self) -> impl Iterator<Item = [String; HEADER.len()]> {
        self.scores.iter().map(|score| {
            [
                self.variant.clone(),
                self.seed.to_string(),
                score.image.clone(),
                score.base.clone(),
                score.metric.clone(),
                score.value.to_string(),
                self.configuration.clone(),
                self.weights.clone(),
                self.steps.to_string(),
                self.minutes.to_string(),
                self.width.to_string(),
                self.parameters.to_string(),
                self.flops_per_pixel.to_string(),
                self.settings.clone(),
            ]
        })
    }

    /// A run with the score of one row. The error is the name of the invalid column.
    fn of_row(row: &[String]) -> Result<Self, &'static str> {
        fn number<T: std::str::FromStr>(row: &[String], column: usize) -> Result<T, &'static str> {
            row[column].parse().map_err(|_| HEADER[column])
        }
        // NaN would count as the best error.
        let value: f64 = number(row, 5)?;
        if !value.is_finite() || row[4] == "relmse" && value < 0.0 {
            return Err(HEADER[5]);
        }
        Ok(ScoredRun {
            variant: row[0].clone(),
            seed: number(row, 1)?,
            scores: vec![ImageValue {
                image: row[2].clone(),
                base: row[3].clone(),
                metric: row[4].clone(),
                value,
            }],
            configuration: row[6].clone(),
            weights: row[7].clone(),
            steps: number(row, 8)?,
            minutes: number(row, 9)?,
            width: number(row, 10)?,
            parameters: number(row, 11)?,
            flops_per_pixel: number(row, 12)?,
            settings: row[13].clone(),
        })
    }

    /// Whether the rows of `other` are of the same run.
    fn is_same(&self, other: &ScoredRun) -> bool {
        let key = |run: &ScoredRun| (run.variant.clone(), run.seed, run.configuration.clone());
        key(self) == key(other)
    }
}

/// The runs of a file, in its order; none if it does not exist.
///
/// # Errors
/// A file that cannot be read; an invalid row.
pub fn read(path: &Path) -> anyhow::Result<Vec<ScoredRun>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let text = read_text(path, MAX_RESULTS).with_context(|| path.display().to_string())?;
    parse(&text).with_context(|| path.display().to_string())
}

/// Writes the runs, complete or not at all.
///
/// # Errors
/// A file that cannot be written.
pub fn write(path: &Path, runs: &[ScoredRun]) -> anyhow::Result<()> {
    let rows = runs.iter().flat_map(ScoredRun::rows);
    let lines = rows.map(|row| line(&row));
    let text = line(&HEADER.map(str::to_owned)) + &lines.collect::<String>();
    Ok(write_whole(path, |file| file.write_all(text.as_bytes()))?)
}

fn parse(text: &str) -> anyhow::Result<Vec<ScoredRun>> {
    let mut rows = records(text).into_iter();
    let header = rows.next().unwrap_or_default();
    ensure!(
        header == HEADER,
        "line 1: expected the columns {}",
        HEADER.join(",")
    );
    let mut runs: Vec<ScoredRun> = Vec::new();
    for (number, row) in rows.enumerate() {
        let place = || format!("row {} below the header", number + 1);
        ensure!(
            row.len() == HEADER.len(),
            "{}: expected {} values, found {}",
            place(),
            HEADER.len(),
            row.len()
        );
        let found = ScoredRun::of_row(&row)
            .map_err(|column| anyhow::anyhow!("{}: {column} is not a number", place()))?;
        match runs.iter_mut().find(|run| run.is_same(&found)) {
            Some(run) => {
                let [new] = &found.scores[..] else {
                    unreachable!("a row has one score")
                };
                let is_new =
                    |old: &ImageValue| (&old.image, &old.metric) != (&new.image, &new.metric);
                ensure!(run.scores.iter().all(is_new), "{}: stands twice", place());
                run.scores.extend(found.scores);
            }
            None => runs.push(found),
        }
    }
    Ok(runs)
}

/// A line of CSV (RFC 4180): values with a comma, a quote, or a line break are quoted.
fn line(values: &[String]) -> String {
    let quoted = |value: &String| {
        if value.contains([',', '"', '\n', '\r']) {
            format!("\"{}\"", value.replace('"', "\"\""))
        } else {
            value.clone()
        }
    };
    values.iter().map(quoted).collect::<Vec<_>>().join(",") + "\n"
}

/// The values of each line of CSV.
fn records(text: &str) -> Vec<Vec<String>> {
    let mut records = Vec::new();
    let mut record = vec![String::new()];
    let mut is_quoted = false;
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        let value = record.last_mut().expect("never empty");
        match letter {
            '"' if is_quoted && letters.peek() == Some(&'"') => {
                letters.next();
                value.push('"');
            }
            '"' => is_quoted = !is_quoted,
            ',' if !is_quoted => record.push(String::new()),
            '\n' if !is_quoted => records.push(std::mem::replace(&mut record, vec![String::new()])),
            '\r' if !is_quoted => {}
            letter => value.push(letter),
        }
    }
    if record != [""] {
        records.push(record);
    }
    records
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A run with an error and an SSIM per image; the base scene is the first letter of an image.
    pub fn scored(variant: &str, seed: u64, scores: &[(&str, f64, f64)]) -> ScoredRun {
        let values = scores.iter().flat_map(|(image, relmse, ssim)| {
            [("relmse", *relmse), ("ssim", *ssim)].map(|(metric, value)| ImageValue {
                image: (*image).to_owned(),
                base: image[..1].to_owned(),
                metric: metric.to_owned(),
                value,
            })
        });
        ScoredRun {
            variant: variant.into(),
            seed,
            configuration: "0123".into(),
            weights: "4567".into(),
            steps: 4000,
            minutes: 1.5,
            width: 16,
            parameters: 1000,
            flops_per_pixel: 125_000.0,
            settings: String::new(),
            scores: values.collect(),
        }
    }

    #[test]
    fn runs_are_read_back_with_any_text() {
        let mut runs = vec![
            scored(
                "DEMC",
                1,
                &[("a", 0.1, 0.25), ("b, \"left\"\nview", 1.0 / 3.0, 1e-9)],
            ),
            scored("SEMC", 2, &[("a", 0.1, 0.25)]),
        ];
        runs[1].settings = "data.augment: [\"flip\", \"rgb\"] instead of []".into();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(RESULTS);
        assert_eq!(read(&path).unwrap(), []);
        write(&path, &runs).unwrap();
        assert_eq!(read(&path).unwrap(), runs);
        let rows = std::fs::read_to_string(&path).unwrap();
        assert!(
            rows.contains("\nSEMC,2,a,a,ssim,0.25,0123,4567,4000,1.5,"),
            "{rows}"
        );
    }

    #[test]
    fn invalid_rows_are_named() {
        let error = |text: &str| format!("{:#}", parse(text).unwrap_err());
        assert!(error("").contains("expected the columns variant,seed"));
        let head = line(&HEADER.map(str::to_owned));
        assert!(
            error(&format!("{head}a,b\n"))
                .contains("row 1 below the header: expected 14 values, found 2")
        );
        let row = |metric: &str, value: &str| format!("DEMC,1,a,a,{metric},{value},,,1,1,1,1,1,\n");
        for (metric, value) in [
            ("ssim", "x"),
            ("ssim", "NaN"),
            ("relmse", "-5"),
            ("relmse", "inf"),
        ] {
            let text = format!("{head}{}", row(metric, value));
            assert!(
                error(&text).contains("value is not a number"),
                "{metric} {value}"
            );
        }
        let twice = format!("{head}{0}{0}", row("ssim", "0.5"));
        assert!(error(&twice).contains("row 2 below the header: stands twice"));
    }
}
