//! Tests of `demc-infer denoise` on a farm: shards, chunks of frames, two workers at once.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::arguments;
use crate::common::{Outcome, demc_infer, run_directory, sample, sample_image};

/// A sequence of three dark frames and one bright frame: their common exposure is not their own.
fn sequence(dir: &Path) -> PathBuf {
    for number in 1..=4 {
        let image = match number {
            4 => "col-classroom-1.exr",
            _ => "gen-table-test-1.exr",
        };
        let frame = dir.join(format!("shot.{number:04}.exr"));
        fs::copy(sample_image(image), frame).expect("copied");
    }
    dir.join("shot.####.exr")
}

/// Denoises with the bundled model or a random one.
fn denoise(model: Option<&Path>, input: &Path, out: &Path, flags: &[&str]) -> Outcome {
    let mut list = arguments!["denoise", input, "-o", out].to_vec();
    list.extend(model.iter().flat_map(|model| arguments!["--model", model]));
    list.extend(flags.iter().map(OsString::from));
    demc_infer(list)
}

fn files(dir: &Path) -> BTreeMap<OsString, Vec<u8>> {
    let entries = fs::read_dir(dir).expect("a directory");
    let paths = entries.map(|entry| entry.expect("an entry").path());
    let named = paths.map(|path| (path.file_name().expect("a name").to_owned(), path));
    named
        .map(|(name, path)| (name, fs::read(path).expect("a file")))
        .collect()
}

#[test]
fn shards_and_chunks_of_a_sequence_give_the_bytes_of_one_run() {
    let dir = tempfile::tempdir().expect("directory");
    let shot = sequence(dir.path());
    let run = |out: &str, flags: &[&str]| {
        let out = dir.path().join(out);
        // The bundled model scales the exposure of a sequence.
        denoise(None, &shot, &out, flags).success();
        files(&out)
    };
    let whole = run("whole", &[]);
    assert_eq!(whole.len(), 4);
    assert_eq!(run("shards", &["--shard", "2/2"]).len(), 2);
    assert_eq!(run("shards", &["--shard", "1/2"]), whole);
    assert_eq!(run("chunks", &["--frames", "1-4x3"]).len(), 2);
    assert_eq!(run("chunks", &["--frames", "2,3-9"]), whole);
}

#[test]
fn each_image_is_in_one_shard_by_name() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let names = |shard: &str| {
        let out = dir.path().join(shard.replace('/', "-of-"));
        let flags = ["--shard", shard];
        denoise(Some(run.path()), &sample().join("test"), &out, &flags).success();
        if out.exists() {
            files(&out).into_keys().collect()
        } else {
            Vec::new()
        }
    };
    assert_eq!(
        names("1/3"),
        ["col-classroom-1.exr", "gen-table-test-1.exr"]
    );
    assert_eq!(names("2/3").len() + names("3/3").len(), 2);
    assert_eq!(names("5/5"), [""; 0]);
}

#[test]
fn wrong_shards_and_frames_are_exit_code_2() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let shot = sequence(dir.path());
    let out = dir.path().join("out");
    for shard in ["0/4", "5/4", "x"] {
        let outcome = denoise(Some(run.path()), &shot, &out, &["--shard", shard]);
        assert_eq!(outcome.code, 2);
        outcome.says("expected I/N with I from 1 to N, such as 1/4");
    }
    let outcome = denoise(Some(run.path()), &shot, &out, &["--frames", "1-2,4x"]);
    assert_eq!(outcome.code, 2);
    outcome.says("`4x`: expected N, FIRST-LAST or FIRST-LASTxSTEP");
    assert!(!out.exists());
}

#[test]
fn a_chunk_may_end_after_the_sequence_and_one_shard_reports_missing_frames() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let shot = sequence(dir.path());
    let out = dir.path().join("out");
    let denoise = |flags: &[&str]| denoise(Some(run.path()), &shot, &out, flags);
    let chunk = denoise(&["--frames", "3-8"]).success();
    chunk.says("shot.####.exr: 4 of 6 chosen frames are after its last one, 4\n");
    let error = format!("{}: none of the chosen frames", shot.display());
    denoise(&["--frames", "5-8"]).failure(2, &error);
    fs::remove_file(dir.path().join("shot.0002.exr")).expect("removed");
    let first = denoise(&["--shard", "1/2", "--overwrite"]);
    assert_eq!(first.code, 1);
    first.says("1 of 4 frames are missing: 2\n");
    let second = denoise(&["--shard", "2/2", "--overwrite"]).success();
    assert!(!second.stderr.contains("missing"), "{}", second.stderr);
}

#[test]
fn two_workers_on_the_same_images_write_whole_files() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let alone = dir.path().join("alone");
    let input = sample().join("test");
    denoise(Some(run.path()), &input, &alone, &["--png"]).success();
    let out = dir.path().join("out");
    for _ in 0..3 {
        let mut worker = Command::new(env!("CARGO_BIN_EXE_demc-infer"));
        worker.args(arguments![
            "denoise",
            input,
            "--model",
            run.path(),
            "-o",
            out
        ]);
        worker.args(["--png", "--overwrite"]);
        worker.stderr(Stdio::piped());
        let workers = [(); 2].map(|()| worker.spawn().expect("started"));
        for worker in workers {
            let ended = worker.wait_with_output().expect("ended");
            let stderr = String::from_utf8_lossy(&ended.stderr).into_owned();
            assert!(ended.status.success(), "{stderr}");
            // Nothing draws a bar where there is no terminal.
            assert!(!stderr.contains(['\r', '\u{1b}', '█', '░']), "{stderr}");
        }
        assert_eq!(files(&out), files(&alone));
    }
}
