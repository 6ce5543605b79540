//! The findings of `fuzz/` for configurations: each once did harm.

use std::fs;
use std::path::Path;

use demc_train::Config;

#[test]
fn every_finding_in_a_configuration_is_sound_or_one_line_now() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/findings/config");
    for file in fs::read_dir(folder).expect("it is in the repository") {
        let path = file.expect("readable").path();
        let bytes = fs::read(&path).expect("readable");
        let text = String::from_utf8_lossy(&bytes);
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
