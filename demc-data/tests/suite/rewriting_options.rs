//! Denoised images with every option of the writer, and errors of writing.

use std::fs;
use std::process::Command;

use crate::support::files::{header, placed, rgb_kinds, scene_kinds, write_file};
use crate::support::layout;
use crate::support::rewritten::{
    PIXELS, SIZE, assert_carried, changes, color, display, headers, method, planes, rewrite,
    with_attributes,
};
use demc_data::image::exr::ExrFile;
use demc_data::image::plane::Plane;
use demc_data::{
    Change, ChannelLayout, Compression, Error, OutputChannels, SamplePrecision, WriteOptions,
    Written, write_denoised,
};
use exr::meta::header::Header;
use exr::prelude::{Compression as Method, SampleType, Text};

#[test]
fn only_colour_and_its_alpha_stay_on_request() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let mut kinds = scene_kinds();
    kinds.push(("A".to_owned(), SampleType::F16));
    kinds.push(("fog.A".to_owned(), SampleType::F16));
    let other = header(Some("other"), SIZE, rgb_kinds(), Method::RLE);
    let main = placed(
        header(Some("main"), SIZE, kinds, Method::ZIP1),
        (3, 4),
        display(),
    );
    let other = placed(other, (3, 4), display());
    write_file(&input, vec![other, with_attributes(main)]);
    let mut named = layout();
    named
        .color
        .iter_mut()
        .for_each(|name| *name = format!("main.{name}"));
    let options = WriteOptions {
        channels: OutputChannels::Color,
        ..WriteOptions::default()
    };
    write_denoised(&input, &named, &color(PIXELS), &output, &options).expect("sound");
    let after = planes(&output);
    let names: Vec<&str> = after
        .iter()
        .map(|(channel, _)| channel.name.as_str())
        .collect();
    assert_eq!(names, ["A", "B", "G", "R"]);
    assert_eq!(after[3].1.to_f32(), color(PIXELS)[..PIXELS]);
    let before = planes(&input);
    let alpha = before.iter().find(|(channel, _)| channel.name == "main.A");
    assert!(alpha.expect("written before").1 == after[0].1);
    // One of two parts, with all its other properties.
    let (before, after) = (&headers(&input)[1], &headers(&output)[0]);
    let channels = after.channels.clone();
    assert_eq!(
        *after,
        Header {
            channels,
            ..before.clone()
        }
    );
}

#[test]
fn the_chosen_precision_is_used_and_clamped_samples_are_counted() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let mut bright = color(PIXELS);
    (bright[3], bright[PIXELS + 4], bright[5]) = (65519.9, 1e9, f32::INFINITY);
    let kinds = [
        (SampleType::F16, None, SampleType::F16),
        (SampleType::F32, None, SampleType::F32),
        (SampleType::U32, None, SampleType::F32),
        (
            SampleType::F32,
            Some(SamplePrecision::Half),
            SampleType::F16,
        ),
        (
            SampleType::F16,
            Some(SamplePrecision::Float),
            SampleType::F32,
        ),
    ];
    for (before, precision, after) in kinds {
        let mut kinds = scene_kinds();
        let color = kinds
            .iter_mut()
            .filter(|(name, _)| ["R", "G", "B"].contains(&name.as_str()));
        color.for_each(|(_, kind)| *kind = before);
        write_file(&input, vec![header(None, SIZE, kinds, Method::ZIP16)]);
        let options = WriteOptions {
            precision,
            ..WriteOptions::default()
        };
        let written = write_denoised(&input, &layout(), &bright, &output, &options);
        let half = after == SampleType::F16;
        assert_eq!(written.expect("sound").clamped, if half { 3 } else { 0 });
        let read: Vec<f32> = ExrFile::open(&output)
            .and_then(|mut file| file.read(&["R", "G", "B"]))
            .expect("sound")
            .iter()
            .flat_map(Plane::to_f32)
            .collect();
        let expected = bright
            .iter()
            .map(|&v| if half { v.min(65504.0) } else { v });
        assert!(read.into_iter().eq(expected), "{before:?} to {after:?}");
        let after_kinds = &headers(&output)[0].channels.list;
        assert!(
            after_kinds
                .iter()
                .all(|c| !["R", "G", "B"].map(Text::from).contains(&c.name)
                    || c.sample_type == after)
        );
    }
}

#[test]
fn a_chosen_compression_is_used_and_its_losses_are_reported() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    write_file(
        &input,
        vec![header(Some("main"), SIZE, scene_kinds(), Method::PIZ)],
    );
    for to in Compression::ALL {
        let options = WriteOptions {
            compression: Some(to),
            ..WriteOptions::default()
        };
        let written = rewrite(&input, &output, &options);
        assert_eq!(Some(headers(&output)[0].compression), Some(method(to)));
        if changes(method(to)) {
            let part = "main".to_owned();
            assert_eq!(written.changes, [Change::Lossy { part, to }]);
            assert_eq!(
                written.changes[0].to_string(),
                format!("part main: compressed with {to}, which also changes the other channels")
            );
        } else {
            assert_eq!(written, Written::default());
            assert_carried(&input, &output, to.name());
        }
    }
}

#[test]
fn an_unusable_input_is_named_and_the_output_stays_unchanged() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    fs::write(&output, "old").expect("writable");
    write_file(
        &input,
        vec![header(None, SIZE, scene_kinds(), Method::ZIP16)],
    );
    let denoise = |layout: &ChannelLayout, pixels: usize| -> Error {
        let options = WriteOptions::default();
        write_denoised(&input, layout, &color(pixels), &output, &options).expect_err("refused")
    };
    let name = |error: &Error| {
        error
            .to_string()
            .replace(&input.display().to_string(), "IN")
    };

    let error = denoise(&layout(), 12);
    assert!(name(&error).ends_with("36 samples of colour do not match 37x45, its current size"));
    let mut other = layout();
    other.color[1] = "beauty.G".to_owned();
    assert!(name(&denoise(&other, PIXELS)).starts_with("IN: no channel beauty.G; the file has B,"));

    let whole = fs::read(&input).expect("just written");
    for length in [whole.len() - 1, whole.len() / 2, 1500, 300, 0] {
        fs::write(&input, &whole[..length]).expect("writable");
        let error = name(&denoise(&layout(), PIXELS));
        assert!(
            error.starts_with("IN: not a readable OpenEXR file: "),
            "{error}"
        );
        assert!(!error.contains('\n'), "{error}");
    }
    assert_eq!(fs::read(&output).expect("it is"), b"old");
    assert_eq!(fs::read_dir(dir.path()).expect("readable").count(), 2);
}

#[test]
fn an_input_may_be_its_own_output() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, copy) = (dir.path().join("in.exr"), dir.path().join("copy.exr"));
    write_file(
        &input,
        vec![header(None, SIZE, scene_kinds(), Method::ZIP16)],
    );
    fs::copy(&input, &copy).expect("writable");
    rewrite(&input, &input, &WriteOptions::default());
    assert_carried(&copy, &input, "in place");
}

/// Runs this test on a disk of this many KiB.
const SCRIPT: &str = r#"mount -t tmpfs -o size="${SIZE}k" tmpfs "$DISK" || exit 99
"$SELF" --exact --ignored --nocapture rewriting_options::writes_until_the_disk_is_full"#;

/// A shell with its own mounts.
#[cfg(target_os = "linux")]
fn shell(script: &str) -> Command {
    let own = fs::metadata("/proc/self").map(|own| std::os::unix::fs::MetadataExt::uid(&own));
    let mut command = Command::new("unshare");
    command.arg(if own.is_ok_and(|uid| uid == 0) {
        "-m"
    } else {
        "-rm"
    });
    command.args(["sh", "-c", script]);
    command
}

#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_up_is_named_and_keeps_the_old_file() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = |script: &str, size: usize| {
        let mut shell = shell(script);
        shell.env("SIZE", size.to_string()).env("DISK", dir.path());
        shell.env("SELF", std::env::current_exe().expect("it runs"));
        shell.output()
    };
    let may_mount = run(r#"mount -t tmpfs -o size=64k tmpfs "$DISK""#, 0);
    if !may_mount.is_ok_and(|output| output.status.success()) {
        assert!(
            std::env::var_os("DEMC_REQUIRE_TMPFS").is_none(),
            "DEMC_REQUIRE_TMPFS=1, but no tmpfs can be mounted"
        );
        println!("skipped: no tmpfs can be mounted here");
        return;
    }
    // The image has 75 KB.
    for size in [8, 12, 16, 40, 64] {
        let output = run(SCRIPT, size).expect("unshare");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "{size} KiB: {text}");
        assert!(text.contains("1 passed"), "{size} KiB: {text}");
    }
}

#[test]
#[ignore = "run by a_disk_that_fills_up_is_named_and_keeps_the_old_file, on a small disk"]
fn writes_until_the_disk_is_full() {
    let Some(disk) = std::env::var_os("DISK").map(std::path::PathBuf::from) else {
        return;
    };
    let dir = tempfile::tempdir().expect("a temporary directory elsewhere");
    let (input, output) = (dir.path().join("in.exr"), disk.join("out.exr"));
    write_file(
        &input,
        vec![header(None, SIZE, scene_kinds(), Method::Uncompressed)],
    );
    fs::write(&output, "old").expect("there is room");
    let options = WriteOptions::default();
    let error = write_denoised(&input, &layout(), &color(PIXELS), &output, &options)
        .expect_err("there is no room");
    assert_eq!(
        error.to_string(),
        format!("cannot write {}", output.display())
    );
    let source = std::error::Error::source(&error)
        .expect("a reason")
        .to_string();
    assert!(source.contains("No space left on device"), "{source}");
    assert_eq!(fs::read(&output).expect("it is there"), b"old");
    assert_eq!(fs::read_dir(&disk).expect("readable").count(), 1);
}
