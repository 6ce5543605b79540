//! The inputs of `fuzz/` for configurations: its seeds are those that come with the project, its findings once did harm.

use std::fs;
use std::path::{Path, PathBuf};

use demc_train::Config;

fn inputs(of: &str) -> Vec<(PathBuf, String)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../fuzz")
        .join(of);
    let files = fs::read_dir(folder).expect("it is in the repository");
    let paths = files.map(|file| file.expect("readable").path());
    let texts = paths.map(|path| {
        let bytes = fs::read(&path).expect("readable");
        (path, String::from_utf8_lossy(&bytes).into_owned())
    });
    texts.collect()
}

#[test]
fn every_seed_of_a_configuration_is_one() {
    let seeds = inputs("seeds/config");
    assert!(seeds.len() >= 5, "{}", seeds.len());
    for (path, text) in seeds {
        let config = Config::parse(&path, &text, &[]).unwrap_or_else(|error| panic!("{error}"));
        let again = Config::parse(&path, &config.to_toml(), &[]);
        assert_eq!(again.unwrap_or_else(|error| panic!("{error}")), config);
    }
}

#[test]
fn every_finding_in_a_configuration_is_sound_or_one_line_now() {
    for (path, text) in inputs("findings/config") {
        // Behind a zero, an edit as of `--set`.
        let (text, set) = text.split_once('\0').unwrap_or((&text, ""));
        let sets: Vec<String> = (!set.is_empty())
            .then(|| set.to_owned())
            .into_iter()
            .collect();
        match Config::parse(&path, text, &sets) {
            Ok(config) => {
                let again = Config::parse(&path, &config.to_toml(), &[]);
                assert_eq!(again.unwrap_or_else(|error| panic!("{error}")), config);
            }
            Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
        }
    }
}
