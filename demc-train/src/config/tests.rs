use std::collections::BTreeMap;

use super::*;

fn parsed(text: &str, sets: &[&str]) -> Result<Config, String> {
    let sets: Vec<String> = sets.iter().map(ToString::to_string).collect();
    Config::parse(Path::new("run.toml"), text, &sets).map_err(|error| error.to_string())
}

fn repository(path: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn defaults_are_the_papers_and_valid() {
    let config = Config::default();
    assert!(config.validate().is_empty());
    assert_eq!(
        (
            config.model.width,
            config.data.batch_size,
            config.train.steps
        ),
        (64, 64, 250_000)
    );
    assert_eq!(config.optimizer.max_grad_norm, None);
}

#[test]
fn all_values_out_of_range_are_named_at_once() {
    let mut config = Config::default();
    config.model.width = 0;
    config.data.stride = 0;
    config.loss.relmse_epsilon = 0.0;
    config.optimizer.lr_start = f64::NAN;
    config.train.ema_decay = Some(0.0);
    config.run.keep = 0;
    config.run.checkpoint_minutes = 0.0;
    let problems = config.validate();
    let keys = [
        "model.width",
        "data.stride",
        "loss.relmse_epsilon",
        "optimizer.lr_start",
        "train.ema_decay",
        "run.keep",
        "run.checkpoint_minutes",
    ];
    for key in keys {
        assert!(
            problems.iter().any(|p| p.starts_with(key)),
            "{key}: {problems:?}"
        );
    }
    assert_eq!(problems.len(), keys.len(), "{problems:?}");
}

#[test]
fn the_variant_without_features_allows_no_albedo_demodulation() {
    let text = "[data]\nalbedo_demodulation_epsilon = 0.07\n";
    assert!(parsed(text, &[]).is_ok());
    let error = parsed(text, &["model.variant=color-only"]).unwrap_err();
    assert!(
        error.contains("data.albedo_demodulation_epsilon = 0.07: must be absent for color-only"),
        "{error}"
    );
    let removed = [
        "model.variant=color-only",
        "data.albedo_demodulation_epsilon=",
    ];
    assert!(parsed(text, &removed).is_ok());
}

#[test]
fn every_unknown_key_is_named_with_its_line_and_the_nearest_known_one() {
    let error = parsed("[train]\nstep = 3\n\n[modle]\nwidth = 3\n", &[]).unwrap_err();
    assert!(
        error.contains("run.toml:2: unknown key `train.step`; did you mean `train.steps`?"),
        "{error}"
    );
    assert!(error.contains("run.toml:4: unknown key `modle`"), "{error}");
}

#[test]
fn wrong_types_name_line_and_expectation() {
    let error = parsed("[train]\nsteps = \"many\"\n", &[]).unwrap_err();
    assert!(
        error.starts_with("run.toml:2: ") && error.contains("expected a whole number from 0 up"),
        "{error}"
    );
}

#[test]
fn a_list_that_is_too_long_is_refused() {
    let text = "[model]\nlevels = [1, 2, 4, 8, 8, 9]";
    for sets in [&[][..], &["run.dir=x"]] {
        let error = parsed(text, sets).unwrap_err();
        assert_eq!(error, "run.toml: model.levels has 6 values instead of 5");
    }
    let error = parsed("", &["model.levels=[1, 2, 4, 8, 8, 9]"]).unwrap_err();
    assert!(error.contains("--set model.levels="), "{error}");
}

#[test]
fn broken_toml_names_the_line() {
    let error = parsed("[train]\nsteps = = 3\n", &[]).unwrap_err();
    assert!(error.starts_with("run.toml:2: "), "{error}");
}

#[test]
fn sets_override_the_file() {
    let config = parsed(
        "[train]\nsteps = 5\n",
        &["train.steps=7", "model.variant=semc", "run.dir = out/x"],
    )
    .unwrap();
    assert_eq!(config.train.steps, 7);
    assert_eq!(config.model.variant, Variant::Semc);
    assert_eq!(config.run_dir(), Path::new("out/x"));
}

#[test]
fn a_set_without_value_restores_the_default() {
    let text =
        "[train]\nsteps = 5\nema_decay = 0.9\n[optimizer]\nkind = \"muon\"\nmuon_max_rows = 64\n";
    let config = parsed(text, &["train.steps=", "train.ema_decay="]).unwrap();
    assert_eq!(config.train, TrainConfig::default());
    let adam = parsed(text, &["optimizer.kind=adam"]).unwrap_err();
    assert!(adam.contains("optimizer.muon_max_rows = 64"), "{adam}");
    let adam = parsed(text, &["optimizer.kind=", "optimizer.muon_max_rows="]).unwrap();
    assert_eq!(adam.optimizer, OptimizerConfig::default());
    assert!(parsed("", &["run.dir="]).is_ok(), "absent already");
}

/// So `train.init` may name weights whose file does not list them.
#[test]
fn keys_of_a_unet_may_have_their_defaults() {
    let variant = "[model]\nvariant = \"unet\"\n";
    let plain = parsed(variant, &[]).unwrap();
    let listed = format!("{variant}size = \"base\"\nguides = \"albedo-normal\"\n");
    assert_eq!(parsed(&listed, &[]).unwrap(), plain);
    let other = parsed(variant, &["model.size=small"]).unwrap();
    assert_eq!(
        other.differences(&plain),
        ["model.size: \"small\" instead of absent"]
    );
}

#[test]
fn bad_sets_are_named() {
    let error = |set| parsed("", &[set]).unwrap_err();
    let misspelt = error("optimizer.lr=1");
    assert!(
        misspelt.contains("did you mean `optimizer.lr_"),
        "{misspelt}"
    );
    assert!(error("train.steps").contains("expected table.key=value"));
    assert!(error("train.steps=many").starts_with("--set train.steps=many: "));
}

#[test]
fn a_key_with_line_breaks_does_not_break_the_message() {
    let error = parsed("[train]\n\"a\\nb\\u001b[2J\" = 1", &[]).unwrap_err();
    assert!(
        error.starts_with("run.toml:2: unknown key `train.a\\nb\\u{1b}[2J`"),
        "{error}"
    );
}

#[test]
fn an_endless_file_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("long.toml");
    std::fs::write(&path, "#".repeat(1 << 20)).unwrap();
    assert!(Config::load(&path, &[]).is_ok());
    std::fs::write(&path, "#".repeat((1 << 20) + 1)).unwrap();
    let error = Config::load(&path, &[]).unwrap_err();
    assert_eq!(error.to_string(), path.display().to_string());
    let source = std::error::Error::source(&error).unwrap().to_string();
    assert!(source.starts_with("more than 1048576 bytes"), "{source}");
}

#[test]
fn keys_are_those_of_the_tables_and_the_values() {
    let keys = Config::keys();
    let values = Config::default().values();
    assert!(values.keys().all(|key| keys.contains(key)));
    let tables: Vec<&str> = source::fields::<Config>();
    for table in &tables {
        assert!(keys.iter().any(|key| key.starts_with(&format!("{table}."))));
    }
    assert_eq!(
        tables,
        ["model", "data", "loss", "optimizer", "train", "run"]
    );
    for optional in ["run.dir", "train.init", "optimizer.muon_max_rows"] {
        assert!(keys.contains(optional) && !values.contains_key(optional));
    }
}

/// The file that is the reference: a key without a default stands there as a comment.
#[test]
fn demc_toml_lists_every_key_with_its_default() {
    let text = repository("configs/demc.toml");
    let mut config: Config = toml::from_str(&text).unwrap();
    config.run.dir = None;
    assert_eq!(config, Config::default());
    let tables: toml::Table = text.parse().unwrap();
    let mut table = "";
    let mut comments = BTreeSet::new();
    for line in text.lines() {
        if let Some(name) = line.strip_prefix('[') {
            table = name.split(']').next().unwrap();
        } else if let Some((key, _)) = line.strip_prefix("# ").and_then(|l| l.split_once(" = ")) {
            comments.insert(format!("{table}.{key}"));
        }
    }
    for key in Config::keys() {
        let (outer, inner) = key.split_once('.').unwrap();
        let is_set = tables[outer].get(inner).is_some();
        assert!(is_set || comments.contains(&key), "{key}");
    }
    let with_comments: Vec<&str> = text
        .lines()
        .map(|line| match line.strip_prefix("# ") {
            Some(set) if set.contains(" = ") => set,
            _ => line,
        })
        .collect();
    toml::from_str::<Config>(&with_comments.join("\n")).expect("comments are valid settings too");
}

/// Rows `| \`table.key\` | type | default | meaning | source |` of the reference page.
fn documented() -> BTreeMap<String, (String, String)> {
    let page = repository("docs/configuration.md");
    let mut rows = BTreeMap::new();
    for line in page.lines().filter(|line| line.starts_with("| `")) {
        let cells: Vec<&str> = line.split(" | ").map(str::trim).collect();
        let key = cells[0].trim_matches(['|', ' ', '`']).to_string();
        // The page has other tables too, such as that of augmentations.
        if !key.contains('.') {
            continue;
        }
        assert_eq!(cells.len(), 5, "five cells: {line}");
        let default = cells[2].trim_matches('`').to_string();
        assert!(!cells[1].is_empty() && !cells[3].is_empty(), "{line}");
        let row = (cells[1].to_string(), default);
        assert!(rows.insert(key, row).is_none(), "two rows: {line}");
    }
    rows
}

#[test]
fn the_reference_page_lists_every_key_with_type_and_default() {
    let rows = documented();
    let keys: Vec<&String> = rows.keys().collect();
    assert_eq!(keys, Config::keys().iter().collect::<Vec<_>>());
    let values = Config::default().values();
    for (key, (kind, default)) in &rows {
        let Some(value) = values.get(key) else {
            assert_eq!(default, "-", "{key} is absent by default");
            continue;
        };
        let kinds: &[&str] = match value {
            Value::Integer(_) => &["integer"],
            Value::Float(_) => &["float"],
            Value::Boolean(_) => &["boolean"],
            Value::Array(_) => &["list"],
            _ => &["string", "path"],
        };
        let known = kinds.iter().any(|known| kind.starts_with(known));
        assert!(known, "{key}: the page says {kind}, expected {kinds:?}");
        let written: toml::Table = format!("value = {default}")
            .parse()
            .unwrap_or_else(|error| panic!("{key} = {default}: {error}"));
        let same = match (&written["value"], value) {
            // Keys of `f32` come back as `f64`.
            (Value::Float(written), Value::Float(value)) => *written as f32 == *value as f32,
            (written, value) => written == value,
        };
        assert!(same, "{key}: the page says {default}, the code {value}");
    }
}

/// All but ablation.toml, a list of variants: see `tools::ablation::spec`.
#[test]
fn every_configuration_of_the_repository_is_valid() {
    let configs = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../configs"));
    let mut count = 0;
    for folder in [configs.to_path_buf(), configs.join("bundled")] {
        for file in std::fs::read_dir(folder).into_iter().flatten() {
            let path = file.unwrap().path();
            let is_toml = path
                .extension()
                .is_some_and(|extension| extension == "toml");
            if is_toml && !path.ends_with("ablation.toml") {
                let config = Config::load(&path, &[]);
                config.unwrap_or_else(|error| panic!("{error}"));
                count += 1;
            }
        }
    }
    assert!(count >= 5, "{count}");
}

#[test]
fn a_resolved_configuration_is_read_back() {
    let text = "[optimizer]\nkind = \"muon\"\nlr_start = 3e-3\n[train]\nema_decay = 0.99\n";
    let config = parsed(text, &[]).unwrap();
    assert_eq!(config.optimizer.muon_max_rows, Some(128));
    assert_eq!(parsed(&config.to_toml(), &[]).unwrap(), config);
}

#[test]
fn only_keys_that_change_numbers_make_another_run() {
    let config = Config::default();
    let mut moved = config.clone();
    moved.run.dir = Some("elsewhere".into());
    moved.data.workers = 2;
    assert!(moved.differences(&config).is_empty());
    let data = "1f  a  train  a  1\n";
    assert_eq!(moved.hash(data), config.hash(data));
    assert_ne!(config.hash(""), config.hash(data));
    assert_eq!(config.hash(data).len(), HASH_DIGITS);
    moved.train.seed = 9;
    assert_ne!(moved.hash(data), config.hash(data));
    assert_eq!(moved.differences(&config), ["train.seed: 9 instead of 1"]);
    moved.train = config.train.clone();
    moved.train.init = Some("runs/other".into());
    let begun = "train.init: \"runs/other\" instead of absent";
    assert_eq!(moved.differences(&config), [begun]);
    let absent = "train.init: absent instead of \"runs/other\"";
    assert_eq!(config.differences(&moved), [absent]);
}
