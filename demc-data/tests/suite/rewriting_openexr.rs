//! Checks rewritten files with OpenEXR's own library.
//! Without it, the test reports that it is skipped; with `DEMC_REQUIRE_OPENEXR=1` it fails.

use std::io::Write;
use std::path::Path;
use std::process::Command;

use demc_data::{ChannelLayout, Compression, OutputChannels, WriteOptions, write_denoised};

/// Writes the input as other programs do, and checks the output against it.
const SCRIPT: &str = include_str!("support/openexr.py");
const PIXELS: usize = 48 * 40;

fn python(arguments: &[&str]) -> Result<String, String> {
    let python = std::env::var_os("DEMC_PYTHON").ok_or("DEMC_PYTHON is not set")?;
    let output = Command::new(&python)
        .arg("-c")
        .arg(SCRIPT)
        .args(arguments)
        .output()
        .map_err(|error| format!("{} does not start: {error}", python.display()))?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    if output.status.success() {
        Ok(text(&output.stdout))
    } else {
        Err(text(&output.stderr))
    }
}

#[test]
fn openexr_finds_the_input_with_another_colour() {
    if let Err(reason) = python(&["check"]) {
        assert!(
            std::env::var("DEMC_REQUIRE_OPENEXR").as_deref() != Ok("1"),
            "DEMC_REQUIRE_OPENEXR=1, but {reason}"
        );
        // Not `println!`, because the test harness captures it.
        writeln!(std::io::stderr(), "skipped: {reason}").expect("stderr can be written");
        return;
    }
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let text = |path: &Path| path.to_string_lossy().into_owned();
    let color: Vec<f32> = (0..3 * PIXELS).map(|i| (i % 2039) as f32 / 8.0).collect();
    let denoise = |layout: &ChannelLayout, options: &WriteOptions| {
        write_denoised(&input, layout, &color, &output, options).expect("sound");
    };
    let check = |kind: &str, what: &str| {
        let checked = python(&["compare", kind, &text(&input), &text(&output)]);
        checked.unwrap_or_else(|error| panic!("{what}: {error}"));
    };
    // Lossless compressions, and compressions that are replaced.
    for compression in [
        "NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB",
    ] {
        for kind in ["scanlines", "tiles"] {
            python(&["write", kind, &text(&input), compression]).expect("a file");
            denoise(&crate::support::layout(), &WriteOptions::default());
            check("all", &format!("{kind} {compression}"));
        }
    }
    python(&["write", "parts", &text(&input), "ZIP"]).expect("a file");
    let mut named = crate::support::layout();
    named
        .color
        .iter_mut()
        .for_each(|name| *name = format!("rgba.{name}"));
    denoise(&named, &WriteOptions::default());
    check("all", "parts");
    let channels = OutputChannels::Color;
    denoise(
        &named,
        &WriteOptions {
            channels,
            ..WriteOptions::default()
        },
    );
    check("color", "colour only");
    // After lossy compression by this crate, the colour is close.
    python(&["write", "scanlines", &text(&input), "ZIP"]).expect("a file");
    for lossy in [
        Compression::Pxr24,
        Compression::B44,
        Compression::B44a,
        Compression::Dwaa,
        Compression::Dwab,
    ] {
        let compression = Some(lossy);
        denoise(
            &crate::support::layout(),
            &WriteOptions {
                compression,
                ..WriteOptions::default()
            },
        );
        check("near", lossy.name());
    }
}
