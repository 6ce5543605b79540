//! Parses bytes as a bundle file.
#![no_main]

use demc_fuzz::check_message;
use demc_infer::BundleFile;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    match BundleFile::parse("model.safetensors".into(), bytes) {
        Ok(file) => {
            for weight in file.weights {
                assert_eq!(weight.shape.iter().product::<usize>(), weight.data.len());
                assert!(weight.data.iter().all(|value| value.is_finite()));
            }
        }
        Err(error) => check_message(&error, "model.safetensors"),
    }
});
