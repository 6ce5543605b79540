//! The file of an ablation: a base configuration, seeds, and a list of variants.
//!
//! ```toml
//! base = "configs/quickstart.toml"
//! dir = "runs/ablation"
//! seeds = [1, 2, 3]
//! match_parameters = true
//!
//! [[variants]]
//! name = "DEMC"
//! set = ["model.variant=demc"]
//! ```

use std::path::{Path, PathBuf};

use demc_model::ModelConfig;
use demc_program::file::{MAX_CONFIGURATION, read_text};
use serde::Deserialize;

use crate::config::{Config, ConfigError, one_line};

/// The key that `seeds` sets.
const SEED: &str = "train.seed";

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct AblationFile {
    /// Configuration of all variants; a relative path starts at the current directory.
    base: PathBuf,
    /// Directory of the runs and the results.
    dir: PathBuf,
    /// Edits for all variants, `table.key=value`.
    #[serde(default)]
    set: Vec<String>,
    /// Seeds; each variant is trained once per seed.
    #[serde(default = "one_seed")]
    seeds: Vec<u64>,
    /// Whether every other variant gets the width with the parameter count closest to the first
    /// one's.
    #[serde(default = "yes")]
    match_parameters: bool,
    /// The variants; the others are compared with the first.
    variants: Vec<VariantEntry>,
    /// Methods without training.
    #[serde(default)]
    baselines: Vec<Baseline>,
    /// Test scenes of which a picture is made.
    #[serde(default)]
    pictures: Vec<String>,
}

/// A method without training.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// Its name in tables.
    pub name: String,
    /// `noisy`; `nfor`, which is computed; or a directory with an EXR file per test scene.
    pub images: String,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct VariantEntry {
    name: String,
    #[serde(default)]
    config: Option<PathBuf>,
    #[serde(default)]
    set: Vec<String>,
    /// How many of the seeds, from the first on; all by default.
    #[serde(default)]
    seeds: Option<usize>,
}

fn one_seed() -> Vec<u64> {
    vec![1]
}

fn yes() -> bool {
    true
}

/// A checked ablation.
#[derive(Clone, Debug)]
pub struct AblationSpec {
    /// The file of the ablation and the configurations of the variants.
    pub files: Vec<PathBuf>,
    /// Directory of the runs and the results.
    pub dir: PathBuf,
    /// The seeds in training order.
    pub seeds: Vec<u64>,
    /// The variants, the reference first.
    pub variants: Vec<AblationVariant>,
    /// Methods without training, which are scored beside the variants.
    pub baselines: Vec<Baseline>,
    /// Test scenes of which a picture is made.
    pub pictures: Vec<String>,
}

/// A variant of an ablation.
#[derive(Clone, Debug)]
pub struct AblationVariant {
    /// Its name in tables.
    pub name: String,
    /// Its configuration; each run sets seed and directory.
    pub config: Config,
    /// The number of seeds from which it is trained: the first ones of the ablation.
    pub seeds: usize,
}

impl AblationSpec {
    /// Reads an ablation. `sets` are edits for all variants and override those of the file.
    ///
    /// # Errors
    /// An invalid file or configuration; equal names or invalid directory names; no seeds or equal
    /// seeds; fewer than two variants.
    pub fn load(path: &Path, sets: &[String]) -> Result<Self, ConfigError> {
        let text = read_text(path, MAX_CONFIGURATION).map_err(|source| ConfigError::Read {
            path: path.into(),
            source,
        })?;
        let file: AblationFile = toml::from_str(&text).map_err(|error| {
            let message = one_line(&error.to_string());
            ConfigError::Source(format!("{}: {message}", path.display()))
        })?;
        let mut problems = file.problems();
        let entries = file.variants.iter();
        let all_sets = [&file.set[..], sets]
            .into_iter()
            .chain(entries.map(|entry| &entry.set[..]));
        if all_sets
            .flatten()
            .any(|set| set.trim_start().starts_with(SEED))
        {
            problems.push(format!("{SEED} cannot be set: `seeds` lists the seeds"));
        }
        if !problems.is_empty() {
            return Err(ConfigError::Values {
                path: path.into(),
                problems,
            });
        }
        let mut variants = Vec::with_capacity(file.variants.len());
        let mut files = vec![path.to_owned()];
        for entry in &file.variants {
            let config = entry.config.as_ref().unwrap_or(&file.base);
            files.push(config.clone());
            let sets = [&file.set[..], &entry.set, sets].concat();
            variants.push(AblationVariant {
                name: entry.name.clone(),
                config: Config::load(config, &sets)?,
                seeds: entry.seeds.unwrap_or(file.seeds.len()),
            });
        }
        if file.match_parameters {
            match_parameters(&mut variants);
        }
        let spec = AblationSpec {
            files,
            dir: file.dir,
            seeds: file.seeds,
            variants,
            baselines: file.baselines,
            pictures: file.pictures,
        };
        let first = &spec.variants[0];
        let runs = spec.seeds.iter().map(|seed| spec.run(first, *seed));
        let problems: Vec<String> = runs.flat_map(|run| run.validate()).collect();
        if !problems.is_empty() {
            return Err(ConfigError::Values {
                path: path.into(),
                problems,
            });
        }
        Ok(spec)
    }

    /// The configuration of one run.
    pub fn run(&self, variant: &AblationVariant, seed: u64) -> Config {
        let mut config = variant.config.clone();
        config.train.seed = seed;
        config.run.dir = Some(self.dir.join(format!("{}-seed-{seed}", variant.name)));
        config
    }

    /// Keys outside `[model]` in which the variants differ from the first.
    pub fn differences(&self) -> Vec<String> {
        let differing = self.variants.iter().flat_map(|variant| {
            let keys = self.differences_of(variant).into_iter();
            keys.map(|key| format!("{}: {key}", variant.name))
        });
        differing.collect()
    }

    /// Keys outside `[model]` in which `variant` differs from the first.
    pub fn differences_of(&self, variant: &AblationVariant) -> Vec<String> {
        let first = &self.variants[0].config;
        let mut same_network = variant.config.clone();
        same_network.model = first.model;
        same_network.differences(first)
    }
}

impl AblationFile {
    fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if self.seeds.is_empty() {
            problems.push("seeds: expected at least one".into());
        }
        for (i, seed) in self.seeds.iter().enumerate() {
            if self.seeds[..i].contains(seed) {
                problems.push(format!("seeds: {seed} is listed twice"));
            }
        }
        if self.variants.len() + self.baselines.len() < 2 || self.variants.is_empty() {
            problems.push("variants: expected at least two, or one and a baseline".into());
        }
        for (i, VariantEntry { name, seeds, .. }) in self.variants.iter().enumerate() {
            let most = self.seeds.len();
            let least = if i == 0 { most } else { 1 };
            if seeds.is_some_and(|seeds| !(least..=most).contains(&seeds)) {
                problems.push(format!(
                    "variants: {name}: seeds: expected {least} to {most}"
                ));
            }
        }
        let variants = self.variants.iter().map(|variant| &variant.name);
        let mut names: Vec<&String> = variants.collect();
        for Baseline { name, .. } in &self.baselines {
            if name.trim().is_empty() || names.contains(&name) {
                problems.push(format!("baselines: `{name}` is empty or listed twice"));
            }
            names.push(name);
        }
        for (i, VariantEntry { name, .. }) in self.variants.iter().enumerate() {
            let plain = |c: char| c.is_alphanumeric() || "-_+. ".contains(c);
            if name.trim().is_empty() || name.starts_with('.') || !name.chars().all(plain) {
                problems.push(format!("variants: `{name}` is not a valid directory name"));
            }
            if self.variants[..i].iter().any(|other| other.name == *name) {
                problems.push(format!("variants: `{name}` is listed twice"));
            }
        }
        problems
    }
}

/// Gives every other variant with encoders the width with the parameter count closest to the first
/// one's. Others keep their own: the paper compares networks of different sizes.
fn match_parameters(variants: &mut [AblationVariant]) {
    if let Some((first, others)) = variants.split_first_mut() {
        let parameters = first.config.model.parameter_count();
        let with_encoders = |variant: &&mut AblationVariant| {
            let spec = variant.config.model.variant.spec();
            !spec.encoders.is_empty()
        };
        for variant in others.iter_mut().filter(with_encoders) {
            let model = variant.config.model;
            variant.config.model = ModelConfig {
                width: model.width_for(parameters),
                ..model
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(text: &str) -> Result<AblationSpec, String> {
        let dir = tempfile::tempdir().unwrap();
        let base = dir.path().join("base.toml");
        std::fs::write(&base, "[model]\nwidth = 16\n").unwrap();
        let path = dir.path().join("ablation.toml");
        let text = format!("base = {base:?}\ndir = \"runs/x\"\n{text}");
        std::fs::write(&path, text).unwrap();
        AblationSpec::load(&path, &["train.steps=7".into()]).map_err(|error| error.to_string())
    }

    const TWO: &str = "[[variants]]\nname = \"DEMC\"\n[[variants]]\nname = \"SEMC\"\nset = [\"model.variant=semc\"]\n";

    #[test]
    fn variants_get_matched_parameters_and_all_edits() {
        let spec = load(TWO).unwrap();
        let [demc, semc] = &spec.variants[..] else {
            panic!("{spec:?}")
        };
        assert_eq!((demc.config.model.width, semc.config.train.steps), (16, 7));
        let [a, b] = [demc, semc].map(|v| v.config.model.parameter_count() as f64);
        assert!((b / a - 1.0).abs() < 0.05, "{a} {b}");
        assert!(semc.config.model.width > 16);
        assert_eq!(spec.differences(), Vec::<String>::new());
        let run = spec.run(semc, 3);
        assert_eq!(run.train.seed, 3);
        assert!(run.run_dir().ends_with("runs/x/SEMC-seed-3"));
    }

    #[test]
    fn widths_stay_without_matching() {
        let spec = load(&format!("match_parameters = false\n{TWO}")).unwrap();
        assert!(spec.variants.iter().all(|v| v.config.model.width == 16));
    }

    #[test]
    fn further_differences_are_named() {
        let text = TWO.replace("semc\"]", "semc\", \"optimizer.lr_start=0.5\"]");
        let spec = load(&text).unwrap();
        assert_eq!(
            spec.differences(),
            ["SEMC: optimizer.lr_start: 0.5 instead of 0.0001"]
        );
    }

    /// Tests run in the folder of their crate, but the paths of the files start at that of the workspace.
    #[test]
    fn the_ablations_of_the_repository_are_valid() {
        let workspace = concat!(env!("CARGO_MANIFEST_DIR"), "/..");
        let no_albedo = "color-only: data.albedo_demodulation_epsilon: absent instead of 0.07";
        let kpcn = [
            "KPCN: loss.l1_hdr: 1 instead of 0",
            "KPCN: loss.relmse: 0 instead of 1",
            "KPCN: loss.separate: 0.75 instead of 0",
            "KPCN: run.validate_every: 125 instead of 500",
            "KPCN: train.steps: 500 instead of 2000",
        ];
        let networks = ["DEMC", "DEMCnoSN", "SEMC"];
        for (file, last, differences) in [
            ("configs/ablation.toml", "color-only", vec![no_albedo]),
            ("configs/paper/figure10.toml", "KPCN", kpcn.into()),
            ("results/comparison/project.toml", "", vec![]),
            ("results/comparison/scaling.toml", "", vec![]),
        ] {
            let text = std::fs::read_to_string(Path::new(workspace).join(file)).unwrap();
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("ablation.toml");
            let absolute = format!("\"{workspace}/configs/");
            std::fs::write(&path, text.replace("\"configs/", &absolute)).unwrap();
            let spec = AblationSpec::load(&path, &[]).unwrap();
            let names: Vec<_> = spec.variants.iter().map(|v| v.name.as_str()).collect();
            assert_eq!(names[..3], networks, "{file}");
            assert_eq!(names[3..].join(" "), last, "{file}");
            assert_eq!(spec.differences(), differences, "{file}");
        }
    }

    #[test]
    fn all_problems_are_named_at_once() {
        let text =
            "seeds = [1, 1]\n[[variants]]\nname = \"../up\"\n[[variants]]\nname = \"../up\"\n";
        let error = load(text).unwrap_err();
        for words in [
            "seeds: 1 is listed twice",
            "`../up` is not a valid",
            "`../up` is listed twice",
        ] {
            assert!(error.contains(words), "{words}: {error}");
        }
        let error = load("seeds = []\n[[variants]]\nname = \"a\"\n").unwrap_err();
        assert!(
            error.contains("seeds: expected at least one") && error.contains("at least two"),
            "{error}"
        );
        let error = load(&format!("seeds = [1, 18446744073709551615]\n{TWO}")).unwrap_err();
        assert!(error.contains("train.seed"), "{error}");
        let text = TWO.replace("semc\"]", "semc\", \"train.seed=5\"]");
        let error = load(&text).unwrap_err();
        assert!(error.contains("train.seed cannot be set"), "{error}");
        assert!(
            load("seed = 1\n")
                .unwrap_err()
                .contains("unknown field `seed`")
        );
        let error = load(&TWO.replace("model.variant", "model.varient")).unwrap_err();
        assert!(error.contains("did you mean `model.variant`?"), "{error}");
    }
}
