//! Tests of `demc-infer export --format onnx`, `export --verify` and `import` through the binary.
//! Shell scripts stand in for Python, which `tests/tests/suite/python_live.rs` uses.

use std::fs;
use std::path::{Path, PathBuf};

use crate::arguments;
use crate::common::{Outcome, demc_infer, export, random_bundle, run_directory};
use demc_infer::{Names, Precision};

/// A shell script that stands in for Python. Its arguments are those of `verify`: `-c SCRIPT KIND
/// FILE FOLDER`.
#[cfg(unix)]
fn interpreter(folder: &Path, script: &str) -> PathBuf {
    use std::os::unix::fs::PermissionsExt;
    let path = folder.join("python");
    fs::write(&path, format!("#!/bin/sh\n{script}\n")).expect("written");
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("made executable");
    path
}

#[cfg(unix)]
fn verified(script: &str) -> (Outcome, bool) {
    let run = run_directory();
    let python = interpreter(run.path(), script);
    let file = run.path().join("x.onnx");
    let python = python.to_str().expect("UTF-8");
    let flags = ["--format", "onnx", "--verify", "--python", python];
    let outcome = export(run.path(), &file, &flags);
    (outcome, file.exists())
}

#[cfg(unix)]
#[test]
fn a_deviation_fails_after_its_numbers_were_printed() {
    // The noisy colour instead of the denoised one.
    let copy = r#"for i in 0 1 2 3; do cp "$5/$i.color" "$5/$i.output"; done; echo Copy 1.0"#;
    let (outcome, exists) = verified(copy);
    assert!(exists, "the export stays, to be looked at");
    outcome.says("Copy 1.0");
    outcome.says("\n2 x 224 x  32  ");
    let stderr = outcome.failure(1, "").stderr;
    assert!(
        stderr.contains("x.onnx: deviates by more than 1e-4"),
        "{stderr}"
    );
}

#[cfg(unix)]
#[test]
fn an_unusable_interpreter_is_a_one_line_error_with_advice() {
    for (script, expected) in [
        (
            "echo \"No module named 'onnxruntime'\" >&2; exit 3",
            "python -m pip install numpy onnxruntime): No module named 'onnxruntime'",
        ),
        ("echo one >&2; echo two >&2; exit 1", "/python: two"),
        ("cat > /dev/null", "0 values instead of 3072"),
        (
            "cat > /dev/null; for i in 0 1 2 3; do : > \"$5/$i.output\"; done",
            "0 values instead of 3072",
        ),
    ] {
        let stderr = verified(script).0.failure(1, "").stderr;
        assert!(stderr.contains(expected), "{stderr}");
    }
}

#[test]
fn flags_that_do_not_go_together_are_usage_errors() {
    let run = run_directory();
    let file = run.path().join("x.onnx");
    let export = |flags: &[&str]| export(run.path(), &file, flags);
    let names = export(&["--format", "onnx", "--names", "torch"]);
    names.failure(2, "--names is for safetensors");
    assert_eq!(export(&["--python", "python3"]).code, 2);
    assert!(!file.exists());
}

#[test]
fn a_tza_file_takes_unets_in_half_precision() {
    let run = run_directory();
    let file = run.path().join("x.tza");
    let export = |flags: &[&str]| export(run.path(), &file, flags);
    export(&["--precision", "f32"]).failure(2, "Open Image Denoise takes only f16");
    let stderr = export(&[]).failure(1, "").stderr;
    assert!(
        stderr.contains("has only networks of variant unet"),
        "{stderr}"
    );
    assert!(!file.exists());
}

#[test]
fn an_onnx_export_is_half_as_large_in_f16() {
    let run = run_directory();
    let size = |precision: &str| {
        let file = run.path().join(precision);
        let flags = ["--format", "onnx", "--precision", precision];
        export(run.path(), &file, &flags).success();
        fs::metadata(file).expect("file").len()
    };
    // The graph itself has 15 kB in both files.
    let (full, half) = (size("f32"), size("f16"));
    assert!(half < full * 6 / 10 + 20_000, "{half} of {full}");
}

#[test]
fn an_import_equals_the_export_byte_for_byte() {
    let run = run_directory();
    let file = |name: &str| run.path().join(name);
    let (torch, back, again) = (file("torch"), file("back"), file("again"));
    let model = file("best.safetensors");
    export(run.path(), &torch, &["--names", "torch"]).success();
    let outcome = demc_infer(arguments!["import", torch, "-o", back]).success();
    outcome.says("read back and compared");
    demc_infer(arguments![
        "import",
        torch,
        "--like",
        run.path(),
        "-o",
        again
    ])
    .success();
    let bytes = fs::read(&model).expect("model");
    assert_eq!(fs::read(&back).expect("imported"), bytes);
    assert_eq!(fs::read(&again).expect("imported"), bytes);

    for (inputs, output, what) in [
        (arguments!["import", torch].to_vec(), &torch, "the weights"),
        (
            arguments!["import", torch, "--like", run.path()].to_vec(),
            &model,
            "the model",
        ),
    ] {
        let mut list = inputs;
        list.extend(arguments!["-o", output]);
        let start = format!("output {} would replace {what}", output.display());
        demc_infer(list).failure(2, &start);
    }
}

#[test]
fn weights_without_a_header_need_a_model() {
    let run = run_directory();
    let bare = run.path().join("bare.safetensors");
    let bundle = random_bundle();
    let mut weights = bundle.model.weights();
    for (weight, spec) in weights.iter_mut().zip(bundle.meta.model.weight_specs()) {
        weight.name = Names::Torch.in_file(&spec);
    }
    let bytes = demc_infer::bundle::tensors::to_bytes(&weights).expect("bytes");
    fs::write(&bare, bytes).expect("written");
    let output = run.path().join("x.safetensors");
    let outcome = demc_infer(arguments!["import", bare, "-o", output]);
    let stderr = outcome.failure(1, "").stderr;
    assert!(stderr.contains("--like MODEL"), "{stderr}");
    assert!(!output.exists());

    demc_infer(arguments![
        "import",
        bare,
        "--like",
        run.path(),
        "-o",
        output
    ])
    .success();
    let expected = random_bundle().to_bytes(Names::Burn, Precision::F32);
    assert_eq!(
        fs::read(&output).expect("imported"),
        expected.expect("bytes")
    );

    weights.truncate(3);
    let bytes = demc_infer::bundle::tensors::to_bytes(&weights).expect("bytes");
    fs::write(&bare, bytes).expect("written");
    let again = run.path().join("y.safetensors");
    let list = arguments!["import", bare, "--like", run.path(), "-o", again];
    let start = format!("{}: missing: ", bare.display());
    demc_infer(list).failure(1, &start);
}
