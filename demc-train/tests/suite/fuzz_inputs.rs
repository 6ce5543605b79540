//! The inputs of `tests/fuzz/`: findings in configurations, each of which caused a failure, and valid logs.

use std::fs;
use std::path::Path;

use demc_train::Config;
use demc_train::record::metrics_log::read_lines;
use serde_json::Value;

#[test]
fn every_finding_is_valid_or_gives_a_one_line_error() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fuzz/findings/config");
    for file in fs::read_dir(folder).expect("it is in the repository") {
        let path = file.expect("readable").path();
        let bytes = fs::read(&path).expect("readable");
        let text = String::from_utf8_lossy(&bytes);
        // Text after a zero byte is an edit, as with `--set`.
        let (text, set) = text.split_once('\0').unwrap_or((&text, ""));
        let sets: Vec<String> = (!set.is_empty())
            .then(|| set.to_owned())
            .into_iter()
            .collect();
        match Config::parse(&path, text, &sets) {
            Ok(config) => {
                let saved = Config::parse(&path, &config.to_toml(), &[]);
                assert_eq!(saved.unwrap_or_else(|error| panic!("{error}")), config);
            }
            Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
        }
    }
}

#[test]
fn every_line_of_a_seed_of_a_log_is_intact() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fuzz/seeds/metrics");
    for file in fs::read_dir(folder).expect("it is in the repository") {
        let path = file.expect("readable").path();
        let bytes = fs::read(&path).expect("readable");
        let found = read_lines::<Value>(&bytes);
        assert!(found.damaged.is_empty(), "{}", path.display());
        assert!(!found.lines.is_empty(), "{}", path.display());
    }
}
