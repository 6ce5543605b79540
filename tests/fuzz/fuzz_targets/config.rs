//! Parses text as a configuration and writes it again.
#![no_main]

use std::path::Path;

use demc_fuzz::check_message;
use demc_train::Config;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    let (text, set) = text.split_once('\0').unwrap_or((text, ""));
    let sets: Vec<String> = (!set.is_empty())
        .then(|| set.to_owned())
        .into_iter()
        .collect();
    match Config::parse(Path::new("run.toml"), text, &sets) {
        Ok(config) => {
            // A run resumes from its saved configuration.
            let again = Config::parse(Path::new("run.toml"), &config.to_toml(), &[]);
            assert_eq!(again.expect("its own"), config);
            let _ = config.patches_per_step();
            let rate = config.learning_rate();
            for step in [0, 1, config.train.steps / 2, config.train.steps] {
                assert!(rate.at(step).is_finite());
            }
        }
        Err(error) if set.is_empty() => check_message(&error, "run.toml"),
        Err(error) => assert!(!error.to_string().contains('\n')),
    }
});
