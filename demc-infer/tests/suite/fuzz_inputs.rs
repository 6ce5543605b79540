//! Tests with the inputs of `tests/fuzz/` for bundles and TZA files: valid seeds, and findings that once caused a
//! failure.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use demc_infer::BundleFile;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../tests/fuzz")
        .join(name)
}

fn inputs(name: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let files = fs::read_dir(folder(name)).expect("it is in the repository");
    let paths = files.map(|file| file.expect("readable").path());
    paths
        .map(|path| (path.clone(), fs::read(path).expect("readable")))
        .collect()
}

/// Writes the header and the smallest tensors of a bundled model:
/// `cargo test --release -p demc-infer --test suite fuzz_inputs -- --ignored`.
#[test]
#[ignore = "writes into tests/fuzz/seeds"]
fn write_seeds() {
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/quality.safetensors");
    let bytes = fs::read(model).expect("it is in the repository");
    let (_, header) = SafeTensors::read_metadata(&bytes).expect("sound");
    let entry = header.metadata().as_ref().expect("a bundle")["demc"].clone();
    let tensors = SafeTensors::deserialize(&bytes).expect("sound");
    for (name, dtype, names) in [("f32", Dtype::F32, "burn"), ("f16", Dtype::F16, "torch")] {
        let mut chosen = Vec::new();
        for (tensor, view) in tensors.iter() {
            // The first half of the bytes of an f32 tensor serve as f16 values.
            let length = view.data().len() / if dtype == Dtype::F16 { 2 } else { 1 };
            if length <= 128 && view.dtype() == Dtype::F32 {
                let data = if dtype == Dtype::F16 {
                    vec![0x3c; length]
                } else {
                    view.data().to_vec()
                };
                chosen.push((tensor.to_owned(), view.shape().to_vec(), data));
            }
        }
        chosen.truncate(6);
        let views = chosen.iter().map(|(tensor, shape, data)| {
            let view = TensorView::new(dtype, shape.clone(), data).expect("as many bytes");
            (tensor.as_str(), view)
        });
        let entry = entry.replace("\"names\":\"burn\"", &format!("\"names\":\"{names}\""));
        let metadata = HashMap::from([("demc".to_owned(), entry)]);
        let bytes = safetensors::serialize(views, Some(metadata)).expect("memory");
        fs::write(
            folder("seeds/bundle").join(format!("{name}.safetensors")),
            bytes,
        )
        .expect("writable");
    }
}

#[test]
fn every_seed_of_a_bundle_parses() {
    let seeds = inputs("seeds/bundle");
    assert_eq!(seeds.len(), 2);
    for (path, bytes) in seeds {
        assert!(bytes.len() < 10_240);
        let file = BundleFile::parse(path, &bytes).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(file.weights.len(), 6);
    }
}

#[test]
fn every_finding_in_a_bundle_is_a_one_line_error() {
    for (path, bytes) in inputs("findings/bundle") {
        if let Err(error) = BundleFile::parse(path.clone(), &bytes) {
            let message = error.to_string();
            assert!(message.contains(&path.display().to_string()), "{message}");
            assert!(!message.contains('\n'), "{message}");
        }
    }
}

#[cfg(unix)]
#[test]
fn a_path_to_no_regular_file_is_refused_at_once() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let fifo = dir.path().join("fifo");
    let made = std::process::Command::new("mkfifo").arg(&fifo).status();
    assert!(made.expect("mkfifo is there").success());
    for path in [fifo.as_path(), "/dev/null".as_ref(), "/dev/zero".as_ref()] {
        let error = BundleFile::read(path).expect_err("no file");
        assert_eq!(error.to_string(), format!("cannot read {}", path.display()));
        let source = std::error::Error::source(&error)
            .expect("a reason")
            .to_string();
        assert_eq!(source, "not a regular file");
    }
}

/// The seeds have too few tensors for a network.
#[test]
fn every_seed_and_finding_in_a_tza_file_is_a_one_line_error() {
    let files = [inputs("seeds/tza"), inputs("findings/tza")].concat();
    assert!(files.len() >= 3);
    for (path, bytes) in files {
        let error = demc_infer::tza::parse(&path, &bytes).expect_err("no network");
        assert!(!error.to_string().contains('\n'), "{error}");
    }
}
