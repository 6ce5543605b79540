//! The inputs in `tests/fuzz/`: seeds are files of every kind; findings are files that once caused a
//! failure.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::files::{header, scene_kinds, tiled, write_file};
use crate::support::layout;
use demc_data::{ChannelLayout, Compression, Dataset, read_frame};
use exr::math::RoundingMode;
use exr::meta::attribute::{LevelMode, SampleType};

fn inputs(target: &str) -> Vec<PathBuf> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../tests/fuzz")
        .join(target);
    let entries = fs::read_dir(&dir).unwrap_or_else(|error| panic!("{}: {error}", dir.display()));
    let mut files: Vec<_> = entries.map(|file| file.expect("readable").path()).collect();
    files.sort();
    files
}

/// The seeds of the EXR targets, the smallest files of each kind. To write them again, run `cargo
/// test --release -p demc-data --test suite fuzz_inputs -- --ignored`.
#[test]
#[ignore = "writes into tests/fuzz/seeds"]
fn write_seeds() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fuzz/seeds/exr");
    fs::create_dir_all(&dir).expect("writable");
    let small = |name: Option<&str>, method| header(name, (6, 5), scene_kinds(), method);
    use exr::prelude::Compression as Method;
    for (name, method) in [
        ("none", Method::Uncompressed),
        ("rle", Method::RLE),
        ("zips", Method::ZIP1),
        ("zip", Method::ZIP16),
        ("piz", Method::PIZ),
        ("pxr24", Method::PXR24),
        ("b44", Method::B44),
        ("b44a", Method::B44A),
        ("dwaa", Method::DWAA(None)),
        ("dwab", Method::DWAB(Some(20.0))),
    ] {
        let size = match name {
            // More than one block of 16 lines.
            "zip" => (6, 20),
            // Compressible blocks; other blocks are stored uncompressed.
            "piz" | "dwaa" | "dwab" => (24, 12),
            _ => (6, 5),
        };
        let part = header(None, size, scene_kinds(), method);
        write_file(&dir.join(format!("{name}.exr")), vec![part]);
    }
    for (name, levels) in [
        ("tiles", LevelMode::Singular),
        ("mip", LevelMode::MipMap),
        ("rip", LevelMode::RipMap),
    ] {
        let part = tiled(small(None, Method::RLE), levels, RoundingMode::Up);
        write_file(&dir.join(format!("{name}.exr")), vec![part]);
    }
    let ids = header(
        Some("ids"),
        (6, 5),
        vec![("id".to_owned(), SampleType::U32)],
        Method::ZIP1,
    );
    let parts = vec![small(Some(""), Method::ZIP16), ids];
    write_file(&dir.join("parts.exr"), parts);
}

#[test]
fn every_seed_of_a_file_reads() {
    let seeds = inputs("seeds/exr");
    assert_eq!(seeds.len(), 14);
    for path in seeds {
        let frame = read_frame(&path, &layout()).unwrap_or_else(|error| panic!("{error}"));
        assert!(frame.width >= 6, "{}", path.display());
    }
    let names = Compression::ALL.map(|compression| format!("{compression}.exr"));
    let seeds = inputs("seeds/exr");
    assert!(
        names
            .iter()
            .all(|name| seeds.iter().any(|seed| seed.ends_with(name)))
    );
}

#[test]
fn every_finding_in_a_file_gives_one_error_line() {
    for path in inputs("findings/exr") {
        if let Err(error) = read_frame(&path, &layout()) {
            let message = error.to_string();
            assert!(message.contains(&path.display().to_string()), "{message}");
            assert!(!message.contains('\n'), "{message}");
        }
    }
}

#[test]
fn every_finding_in_a_layout_is_valid_or_gives_one_error_line() {
    for path in inputs("findings/layout") {
        let bytes = fs::read(&path).expect("readable");
        if let Err(error) = ChannelLayout::from_toml("x.toml", &String::from_utf8_lossy(&bytes)) {
            let message = error.to_string();
            assert!(!message.contains('\n'), "{}: {message}", path.display());
        }
    }
}

#[test]
fn every_seed_of_a_manifest_opens() {
    let dir = tempfile::tempdir().expect("directory");
    fs::create_dir(dir.path().join("sub")).expect("writable");
    let image = inputs("seeds/exr")
        .into_iter()
        .find(|path| path.ends_with("none.exr"))
        .expect("a seed");
    for name in ["a.exr", "b.exr", "sub/c.exr"] {
        fs::copy(&image, dir.path().join(name)).expect("copied");
    }
    for seed in inputs("seeds/manifest") {
        fs::copy(&seed, dir.path().join("manifest.json")).expect("copied");
        let set = Dataset::open(dir.path(), &layout())
            .unwrap_or_else(|error| panic!("{}: {error}", seed.display()));
        assert_eq!(set.scenes.len(), 3, "{}", seed.display());
    }
}
