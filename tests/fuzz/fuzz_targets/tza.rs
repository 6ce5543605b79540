//! Parses bytes as a TZA file, or a library with such files in it.
#![no_main]

use std::path::Path;

use demc_fuzz::check_message;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    match demc_infer::tza::parse(Path::new("weights.tza"), bytes) {
        Ok(sets) => assert!(!sets.is_empty()),
        Err(error) => check_message(&error, "weights.tza"),
    }
});
