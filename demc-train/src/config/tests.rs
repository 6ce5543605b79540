use super::*;

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
    assert_eq!(config.train.grad_clip, 0.0);
}

#[test]
fn all_values_out_of_range_are_named_at_once() {
    let mut config = Config::default();
    config.model.width = 0;
    config.data.stride = 0;
    config.train.lr_start = f64::NAN;
    config.run.keep = 0;
    let problems = config.validate();
    for key in ["model.width", "data.stride", "train.lr_start", "run.keep"] {
        assert!(
            problems.iter().any(|p| p.starts_with(key)),
            "{key}: {problems:?}"
        );
    }
    assert_eq!(problems.len(), 4);
}

#[test]
fn the_control_without_features_is_not_divided_by_one() {
    let mut config = Config::default();
    config.data.demodulate = 0.07;
    assert_eq!(config.validate(), Vec::<String>::new());
    config.model.variant = Variant::ColorOnly;
    let problems = config.validate();
    assert_eq!(problems.len(), 1, "{problems:?}");
    assert!(problems[0].starts_with("data.demodulate = 0.07: must be 0 for color-only"));
}

#[test]
fn a_key_with_line_breaks_does_not_break_the_message() {
    let text = "[train]\n\"a\\nb\\u001b[2J\" = 1";
    let error = Config::parse(Path::new("x.toml"), text, &[]).unwrap_err();
    let error = error.to_string();
    assert!(
        error.starts_with("x.toml:2: unknown key `train.a\u{fffd}b\u{fffd}[2J`"),
        "{error}"
    );
}

#[test]
fn a_file_without_end_is_refused() {
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

/// The file that the documentation calls the reference.
#[test]
fn demc_toml_names_every_key_with_its_default() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/demc.toml");
    let text = std::fs::read_to_string(path).unwrap();
    let mut config: Config = toml::from_str(&text).unwrap();
    config.run.dir = PathBuf::new();
    assert_eq!(config, Config::default());
    let table: toml::Table = text.parse().unwrap();
    for key in source::leaves(&config).keys() {
        let (outer, inner) = key.split_once('.').unwrap();
        assert!(table[outer].get(inner).is_some(), "{key}");
    }
}

/// But ablation.toml, which is a list of variants: see `ablation::spec`.
#[test]
fn every_configuration_that_comes_along_is_valid() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs");
    for name in ["demc", "demc-nosn", "semc", "quickstart", "renders"] {
        let path = Path::new(folder).join(name).with_extension("toml");
        let problems = Config::load(&path, &[]).map(|config| config.validate());
        assert_eq!(problems.unwrap(), [""; 0], "{name}");
    }
}

#[test]
fn resolved_configuration_is_one_itself() {
    let mut config = Config::default();
    config.train.lr_start = 3e-3;
    assert_eq!(toml::from_str::<Config>(&config.to_toml()).unwrap(), config);
}

#[test]
fn only_what_changes_numbers_makes_another_run() {
    let config = Config::default();
    let mut moved = config.clone();
    moved.run.dir = "elsewhere".into();
    moved.data.workers = 2;
    assert!(moved.differences(&config).is_empty());
    moved.train.seed = 9;
    assert_eq!(moved.differences(&config), ["train.seed = 9, there 1"]);
    moved.train = config.train.clone();
    moved.train.init = "runs/other".into();
    let begun = "train.init = \"runs/other\", there \"\"";
    assert_eq!(moved.differences(&config), [begun]);
}
