//! Tests with malicious files and with paths given by mistake. Each is refused at once, in one
//! line, with no more memory than the file has bytes.

use std::fs;
use std::path::Path;

use burn::tensor::Device;
use demc_model::Variant;

use super::testing::{bundle, without_checksum};
use super::*;

fn file(header: &[u8], data: &[u8]) -> Vec<u8> {
    let length = header.len() as u64;
    [&length.to_le_bytes()[..], header, data].concat()
}

/// The one-line error when a file with these bytes is loaded, without its path. Importing fails,
/// too.
fn refusal(bytes: &[u8]) -> String {
    let path = tempfile::NamedTempFile::new()
        .expect("file")
        .into_temp_path();
    fs::write(&path, bytes).expect("written");
    let error = Bundle::load(&path, &Device::flex()).expect_err("refused");
    let line = |error: &dyn std::error::Error| -> String {
        let chain: Vec<_> = std::iter::successors(Some(error), |e| e.source())
            .map(|e| e.to_string())
            .collect();
        let line = chain.join(": ");
        assert!(!line.contains(|c: char| c.is_control()), "{line:?}");
        let start = format!("{}: ", path.display());
        line.strip_prefix(&start).expect("path first").to_string()
    };
    let imported = BundleFile::import(&path, None).expect_err("refused");
    line(&imported);
    line(&error)
}

/// A header with the metadata of a valid bundle and these tensors as JSON text.
fn header(tensors: &str) -> Vec<u8> {
    let bytes = bundle(Variant::Demc).to_bytes(Names::Burn, Precision::F32);
    let bytes = bytes.expect("bytes");
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).expect("header");
    let mut metadata = header.metadata().clone().expect("metadata");
    let entry = without_checksum(&metadata["demc"]);
    metadata.insert("demc".into(), entry);
    let metadata = serde_json::to_string(&metadata).expect("strings");
    format!(r#"{{"__metadata__":{metadata}{tensors}}}"#).into_bytes()
}

fn tensor(name: &str, dtype: &str, shape: &str, from: u64, to: u64) -> String {
    format!(r#","{name}":{{"dtype":"{dtype}","shape":{shape},"data_offsets":[{from},{to}]}}"#)
}

const DAMAGED: &str = "cut short, damaged or no safetensors file: ";

#[test]
fn invalid_header_lengths_are_refused() {
    for length in [
        1 << 22,
        (1 << 22) + 1,
        100_000_001,
        1 << 40,
        u64::MAX - 7,
        u64::MAX,
    ] {
        let mut bytes = file(&header(""), b"");
        bytes[..8].copy_from_slice(&length.to_le_bytes());
        let line = refusal(&bytes);
        assert!(line.starts_with(DAMAGED), "{length}: {line}");
    }
    assert!(refusal(&u64::MAX.to_le_bytes()).ends_with("a header of 18446744073709551615 bytes"));
    assert!(refusal(&file(b"", b"")).starts_with(DAMAGED));
}

#[test]
fn offsets_that_overlap_leave_gaps_or_leave_the_file_are_refused() {
    let max = u64::MAX;
    for (what, tensors) in [
        (
            "twice the same",
            tensor("a", "F32", "[1]", 0, 4) + &tensor("b", "F32", "[1]", 0, 4),
        ),
        (
            "overlapping",
            tensor("a", "F32", "[2]", 0, 8) + &tensor("b", "F32", "[1]", 4, 8),
        ),
        (
            "a gap",
            tensor("a", "F32", "[1]", 0, 4) + &tensor("b", "F32", "[1]", 8, 12),
        ),
        ("not from the start", tensor("a", "F32", "[1]", 4, 8)),
        ("backwards", tensor("a", "F32", "[1]", 8, 4)),
        (
            "beyond the end",
            tensor("a", "F32", "[1000000]", 0, 4_000_000),
        ),
        (
            "far beyond the end",
            tensor("a", "U8", "[1152921504606846976]", 0, 1 << 60),
        ),
        ("beyond every file", tensor("a", "F32", "[1]", max - 4, max)),
        ("fewer than the shape", tensor("a", "F32", "[4]", 0, 8)),
        (
            "a shape that overflows",
            tensor("a", "F32", "[4294967296,4294967296,4]", 0, 4),
        ),
        (
            "bits that overflow",
            tensor("a", "F32", "[4611686018427387904]", 0, 0),
        ),
        (
            "negative",
            r#","a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}"#.into(),
        ),
        ("half a byte", tensor("a", "F4", "[1]", 0, 1)),
        ("a type of nobody", tensor("a", "F33", "[1]", 0, 4)),
        ("no offsets", r#","a":{"dtype":"F32","shape":[1]}"#.into()),
    ] {
        let line = refusal(&file(&header(&tensors), &[0; 8]));
        assert!(line.starts_with(DAMAGED), "{what}: {line}");
    }
}

#[test]
fn data_longer_than_the_header_states_is_refused() {
    let tensors = tensor("a", "F32", "[1]", 0, 4);
    let line = refusal(&file(&header(&tensors), &[0; 5]));
    assert!(line.starts_with(DAMAGED), "{line}");
}

#[test]
fn a_tensor_listed_twice_is_refused() {
    let tensors = tensor("a", "F32", "[1]", 0, 4) + &tensor("a", "F32", "[1]", 4, 8);
    assert!(refusal(&file(&header(&tensors), &[0; 8])).starts_with(DAMAGED));
}

#[test]
fn headers_that_are_no_json_object_are_refused() {
    let deep = "[".repeat(100_000);
    let objects = r#"{"a":"#.repeat(100_000);
    let entry = format!(r#"{{"__metadata__":{{"demc":"{deep}"}}}}"#);
    let number = r#"{"__metadata__":{"demc":7}}"#;
    for header in [&b"\xff\xfe{}"[..], b"null  ", b"[1,2] ", b"{\"a\":"] {
        assert!(refusal(&file(header, b"")).starts_with(DAMAGED));
    }
    for header in [&deep, &objects, number] {
        let line = refusal(&file(header.as_bytes(), b""));
        assert!(line.starts_with(DAMAGED), "{line}");
    }
    let line = refusal(&file(entry.as_bytes(), b""));
    assert!(line.starts_with("header entry `demc`: "), "{line}");
    for header in [
        "{}",
        r#"{"__metadata__":{}}"#,
        r#"{"__metadata__":{"format":"pt"}}"#,
    ] {
        let line = refusal(&file(header.as_bytes(), b""));
        assert!(line.contains("no DEMC bundle"), "{line}");
    }
}

#[test]
fn invalid_entries_are_refused() {
    let good = String::from_utf8(header("")).expect("text");
    for (from, to, expected) in [
        (
            r#"\"width\":2"#,
            r#"\"width\":1000000000"#,
            "model.width = 1000000000",
        ),
        (r#"\"width\":2"#, r#"\"width\":-2"#, "invalid value"),
        (
            r#"\"levels\":[1,2,4,8,8]"#,
            r#"\"levels\":[1,2,4,8,0]"#,
            "model.levels = [1, 2, 4, 8, 0]",
        ),
        (r#"\"width\":2"#, r#"\"width\":[[[[2]]]]"#, "invalid type"),
        (
            r#"\"gamma\":2.2"#,
            r#"\"gamma\":1e39"#,
            "number out of range",
        ),
        (
            r#"\"gamma\":2.2"#,
            r#"\"gamma\":1e999"#,
            "number out of range",
        ),
        (
            r#"\"gamma\":2.2"#,
            r#"\"gamma\":-0.0"#,
            "normalizer.gamma: -0 is not above 0",
        ),
        (
            r#"\"gamma\":2.2"#,
            r#"\"gamma\":2.2,\"demodulate\":-0.07"#,
            "normalizer.demodulate: -0.07 is not 0 or above",
        ),
        (
            r#"\"normal\":[\"normal.X\""#,
            r#"\"normal\":[\"\\u001b[2J\""#,
            r#"layout: channel "\u{1b}[2J" contains a control character"#,
        ),
        (
            r#"\"normal\":[\"normal.X\""#,
            r#"\"normal\":[\"R\""#,
            r#"layout: channel "R" is named twice"#,
        ),
        (
            r#"\"step\":12"#,
            r#"\"step\":12e400"#,
            "number out of range",
        ),
        (
            r#"\"demc\""#,
            r#"\"\\u001b[2J\\n\""#,
            "unknown variant `\\u{1b}[2J\\n`",
        ),
    ] {
        assert!(good.contains(from), "{from}");
        let line = refusal(&file(good.replacen(from, to, 1).as_bytes(), b""));
        assert!(line.contains(expected), "{to}: {line}");
    }
}

#[test]
fn names_that_would_break_the_line_are_escaped() {
    let tensors = tensor("\\n\\u001b[31merror", "I64", "[1]", 0, 8);
    let line = refusal(&file(&header(&tensors), &[0; 8]));
    assert_eq!(
        line,
        "tensor \\n\\u{1b}[31merror: type I64; expected F32 or F16"
    );
    let tensors = tensor("a\\nb", "F32", "[1]", 4, 8);
    assert!(refusal(&file(&header(&tensors), &[0; 8])).contains("a\\nb"));
}

/// A wide network without weights costs nothing: the first missing weight ends the load.
#[test]
fn a_network_without_weights_is_not_built() {
    let good = String::from_utf8(header("")).expect("text");
    let wide = good.replacen(r#"\"width\":2"#, r#"\"width\":256"#, 1);
    let path = tempfile::NamedTempFile::new()
        .expect("file")
        .into_temp_path();
    fs::write(&path, file(wide.as_bytes(), b"")).expect("written");
    let error = Bundle::load(&path, &Device::flex()).expect_err("no weights");
    assert!(matches!(error, BundleError::Weights { .. }), "{error}");
    let error = BundleFile::import(&path, None).expect_err("no weights");
    assert!(matches!(error, BundleError::Import { .. }), "{error}");
}

#[test]
fn every_byte_of_a_header_may_be_damaged() {
    let bytes = bundle(Variant::ColorOnly).to_bytes(Names::Torch, Precision::F16);
    let bytes = bytes.expect("bytes");
    let length = u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize;
    let path = Path::new("memory");
    for at in 0..8 + length {
        for change in [0x01, 0x10, 0x80, 0xff] {
            let mut bytes = bytes.clone();
            bytes[at] ^= change;
            let error = BundleFile::parse(path.into(), &bytes).expect_err("the checksum differs");
            let text = error.to_string();
            assert!(!text.contains(|c: char| c.is_control()), "{at}: {text:?}");
        }
    }
}

/// An endless file is not read.
#[cfg(unix)]
#[test]
fn a_device_is_no_model() {
    let error = BundleFile::read(Path::new("/dev/zero")).expect_err("zeros");
    let BundleError::Read { source, .. } = error else {
        panic!("{error}");
    };
    assert_eq!(source.to_string(), "not a regular file");
}
