//! What an ablation compares: a TOML file with a base configuration, seeds, and a list of variants.
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
use serde::Deserialize;

use crate::config::{Config, ConfigError, one_line};

/// The file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    /// Configuration that variants start from; a relative path starts at the current directory.
    base: PathBuf,
    /// Directory of the runs and of the result.
    dir: PathBuf,
    /// Edits for all variants, `table.key=value`.
    #[serde(default)]
    set: Vec<String>,
    /// A run a variant and seed.
    #[serde(default = "one_seed")]
    seeds: Vec<u64>,
    /// Whether every variant but the first gets the width at which it has nearest to the first one's parameters.
    #[serde(default = "yes")]
    match_parameters: bool,
    /// What is compared; the first is what the others are compared with.
    variants: Vec<Entry>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    #[serde(default)]
    config: Option<PathBuf>,
    #[serde(default)]
    set: Vec<String>,
}

fn one_seed() -> Vec<u64> {
    vec![1]
}

fn yes() -> bool {
    true
}

/// An ablation that can run.
#[derive(Clone, Debug)]
pub struct Spec {
    /// Directory of the runs and of the result.
    pub dir: PathBuf,
    /// The seeds, in the order of training.
    pub seeds: Vec<u64>,
    /// What is compared, the reference first.
    pub variants: Vec<Variant>,
}

/// One of the things compared.
#[derive(Clone, Debug)]
pub struct Variant {
    /// What tables call it.
    pub name: String,
    /// Its configuration; seed and directory are set run by run.
    pub config: Config,
}

impl Spec {
    /// Reads an ablation; `sets` are edits for all its variants, which win over the file's.
    ///
    /// # Errors
    /// A file or configuration that cannot be used; names that are no directory names or not different; no seeds or one of
    /// them twice; fewer than two variants.
    pub fn load(path: &Path, sets: &[String]) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read {
            path: path.into(),
            source,
        })?;
        let file: File = toml::from_str(&text).map_err(|error| {
            let message = one_line(&error.to_string());
            ConfigError::Source(format!("{}: {message}", path.display()))
        })?;
        let problems = file.problems();
        if !problems.is_empty() {
            return Err(ConfigError::Values {
                path: path.into(),
                problems,
            });
        }
        let mut variants = Vec::with_capacity(file.variants.len());
        for entry in &file.variants {
            let config = entry.config.as_ref().unwrap_or(&file.base);
            let sets = [&file.set[..], &entry.set, sets].concat();
            variants.push(Variant {
                name: entry.name.clone(),
                config: Config::load(config, &sets)?,
            });
        }
        if file.match_parameters {
            match_parameters(&mut variants);
        }
        Ok(Spec {
            dir: file.dir,
            seeds: file.seeds,
            variants,
        })
    }

    /// The configuration of one run.
    pub fn run(&self, variant: &Variant, seed: u64) -> Config {
        let mut config = variant.config.clone();
        config.train.seed = seed;
        config.run.dir = self.dir.join(format!("{}-seed-{seed}", variant.name));
        config
    }

    /// What the variants do not have in common but the network: keys by which their batches, steps or losses differ from the
    /// first one's, in words.
    pub fn differences(&self) -> Vec<String> {
        let (first, others) = self.variants.split_first().expect("at least two");
        let differing = others.iter().flat_map(|variant| {
            let mut same_network = variant.config.clone();
            same_network.model = first.config.model;
            let keys = same_network.differences(&first.config);
            keys.into_iter()
                .map(|key| format!("{}: {key}", variant.name))
        });
        differing.collect()
    }
}

impl File {
    fn problems(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if self.seeds.is_empty() {
            problems.push("seeds: none".into());
        }
        for (i, seed) in self.seeds.iter().enumerate() {
            if self.seeds[..i].contains(seed) {
                problems.push(format!("seeds: {seed} twice"));
            }
        }
        if self.variants.len() < 2 {
            problems.push("variants: a comparison takes two or more".into());
        }
        for (i, Entry { name, .. }) in self.variants.iter().enumerate() {
            let plain = |c: char| c.is_alphanumeric() || "-_+. ".contains(c);
            if name.trim().is_empty() || name.starts_with('.') || !name.chars().all(plain) {
                problems.push(format!(
                    "variants: the name `{name}` is no name of a directory"
                ));
            }
            if self.variants[..i].iter().any(|other| other.name == *name) {
                problems.push(format!("variants: `{name}` twice"));
            }
        }
        problems
    }
}

/// Gives every variant but the first the width at which it has nearest to the first one's parameters.
fn match_parameters(variants: &mut [Variant]) {
    if let Some((first, others)) = variants.split_first_mut() {
        let parameters = first.config.model.parameter_count();
        for variant in others {
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

    fn load(text: &str) -> Result<Spec, String> {
        let dir = tempfile::tempdir().unwrap();
        let base = dir.path().join("base.toml");
        std::fs::write(&base, "[model]\nwidth = 16\n").unwrap();
        let path = dir.path().join("ablation.toml");
        let text = format!("base = {base:?}\ndir = \"runs/x\"\n{text}");
        std::fs::write(&path, text).unwrap();
        Spec::load(&path, &["train.steps=7".into()]).map_err(|error| error.to_string())
    }

    const TWO: &str = "[[variants]]\nname = \"DEMC\"\n[[variants]]\nname = \"SEMC\"\nset = [\"model.variant=semc\"]\n";

    #[test]
    fn variants_get_the_first_ones_parameters_and_all_edits() {
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
        assert!(run.run.dir.ends_with("runs/x/SEMC-seed-3"));
    }

    #[test]
    fn widths_stay_where_they_are_not_matched() {
        let spec = load(&format!("match_parameters = false\n{TWO}")).unwrap();
        assert!(spec.variants.iter().all(|v| v.config.model.width == 16));
    }

    #[test]
    fn what_else_differs_is_named() {
        let text = TWO.replace("semc\"]", "semc\", \"train.lr_start=0.5\"]");
        let spec = load(&text).unwrap();
        assert_eq!(
            spec.differences(),
            ["SEMC: train.lr_start = 0.5, there 0.0001"]
        );
    }

    /// Tests run in the folder of their crate, `base` starts at that of the workspace.
    #[test]
    fn the_ablations_that_come_along_can_run() {
        let workspace = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let no_texture = "color-only: data.demodulate = 0, there 0.07";
        for (folder, differences) in [("configs", vec![no_texture]), ("results/renders", vec![])] {
            let folder = workspace.join(folder);
            let text = std::fs::read_to_string(folder.join("ablation.toml")).unwrap();
            let relative = text
                .lines()
                .find(|line| line.starts_with("base = "))
                .unwrap();
            let base = workspace.join(relative.split('"').nth(1).unwrap());
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("ablation.toml");
            std::fs::write(&path, text.replace(relative, &format!("base = {base:?}"))).unwrap();
            let spec = Spec::load(&path, &[]).unwrap();
            let names: Vec<_> = spec.variants.iter().map(|v| &v.name).collect();
            assert_eq!(names, ["DEMC", "DEMCnoSN", "SEMC", "color-only"]);
            assert_eq!(spec.differences(), differences);
        }
    }

    #[test]
    fn all_problems_are_named_at_once() {
        let text =
            "seeds = [1, 1]\n[[variants]]\nname = \"../up\"\n[[variants]]\nname = \"../up\"\n";
        let error = load(text).unwrap_err();
        for words in ["seeds: 1 twice", "`../up` is no name", "`../up` twice"] {
            assert!(error.contains(words), "{words}: {error}");
        }
        let error = load("seeds = []\n[[variants]]\nname = \"a\"\n").unwrap_err();
        assert!(
            error.contains("seeds: none") && error.contains("two or more"),
            "{error}"
        );
        assert!(
            load("seed = 1\n")
                .unwrap_err()
                .contains("unknown field `seed`")
        );
        let error = load(&TWO.replace("model.variant", "model.varient")).unwrap_err();
        assert!(error.contains("did you mean `model.variant`?"), "{error}");
    }
}
