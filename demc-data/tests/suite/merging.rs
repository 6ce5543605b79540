//! Files joined by `demc_data::image::exr::merge`: bits, types, attributes, and refusals.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::files::{header, placed, rgb_kinds, write_file};
use crate::support::rewritten::{display, headers, planes, with_attributes};
use crate::support::{ZIP, half, named, part, sample, write, write_parts};
use demc_data::image::channel::ChannelType;
use demc_data::image::exr::ExrFile;
use demc_data::image::exr::merge::{MergeInput, Merged, merge};
use demc_data::{ChannelLayout, Error};
use exr::meta::attribute::IntegerBounds;
use exr::prelude::{Compression, FlatSamples};

fn joined(output: &Path, files: &[(Option<&str>, &Path)]) -> Result<Merged, Error> {
    let inputs = files.iter().map(|(prefix, path)| {
        let file = ExrFile::open(path)?;
        let prefix = prefix.map(str::to_owned);
        let strip = None;
        Ok(MergeInput {
            file,
            prefix,
            strip,
        })
    });
    merge(&mut inputs.collect::<Result<Vec<_>, Error>>()?, output)
}

struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary directory"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a file of 2x2 pixels with these half channels.
    fn small(&self, name: &str, channels: &[&str]) -> PathBuf {
        let path = self.path(name);
        let samples = |channel: &&str| ((*channel).to_owned(), half([1.0; 4]));
        write(&path, (2, 2), channels.iter().map(samples).collect());
        path
    }

    /// Checks that the files are refused with `message`, and that nothing is written.
    fn refused(&self, files: &[(Option<&str>, &Path)], message: &str) {
        let error = joined(&self.path("out.exr"), files)
            .expect_err("a refusal")
            .to_string();
        assert!(error.contains(message), "{error}, not {message}");
        assert!(!error.contains('\n'), "{error}");
        let mut names = fs::read_dir(self.0.path())
            .expect("readable")
            .map(|entry| entry.expect("readable").file_name())
            .map(|name| name.to_string_lossy().into_owned());
        assert!(
            names.all(|name| !name.contains("out")),
            "something is written"
        );
    }
}

#[test]
fn samples_keep_their_types_and_bits() {
    let files = Files::new();
    let (a, b) = (files.path("a.exr"), files.path("b.exr"));
    let odd = [f32::NAN, f32::NEG_INFINITY, -0.0, 1e-40];
    let whole = FlatSamples::U32(vec![0, 1, 1 << 31, u32::MAX]);
    write(&a, (2, 2), named([("R", half(odd)), ("id", whole)]));
    write(&b, (2, 2), named([("Z", FlatSamples::F32(odd.to_vec()))]));
    let output = files.path("out.exr");
    let merged = joined(&output, &[(None, &a), (Some("depth"), &b)]).expect("joined");
    assert_eq!(merged.channels, ["R", "depth.Z", "id"]);
    assert_eq!(merged.conflicts, [""; 0]);

    let before = [planes(&a), planes(&b)].concat();
    let after = planes(&output);
    let kinds: Vec<ChannelType> = after.iter().map(|(channel, _)| channel.kind).collect();
    assert_eq!(
        kinds,
        [ChannelType::Half, ChannelType::Float, ChannelType::Uint]
    );
    for (new, old) in [(0, 0), (1, 2), (2, 1)] {
        // NaN differs from itself.
        assert_eq!(
            format!("{:?}", after[new].1),
            format!("{:?}", before[old].1)
        );
        let bits = |plane: &[f32]| plane.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&after[new].1.to_f32()), bits(&before[old].1.to_f32()));
    }
}

#[test]
fn a_scene_in_pieces_comes_back_whole() {
    let files = Files::new();
    let scene = sample().join("train/col-spaceship-0.exr");
    let all = planes(&scene);
    let groups = [
        "", "normal", "position", "albedo1", "albedo2", "mask", "ref",
    ];
    let mut pieces = Vec::new();
    for group in groups {
        let own = all.iter().filter_map(|(channel, plane)| {
            let (layer, name) = channel.name.rsplit_once('.').unwrap_or(("", &channel.name));
            (layer == group).then(|| (name.to_owned(), FlatSamples::F32(plane.to_f32())))
        });
        let path = files.path(&format!("piece-{group}.exr"));
        write(&path, (224, 224), own.collect());
        pieces.push((Some(group).filter(|group| !group.is_empty()), path));
    }
    let pieces: Vec<(Option<&str>, &Path)> = pieces
        .iter()
        .map(|(name, path)| (*name, path.as_path()))
        .collect();
    let output = files.path("out.exr");
    joined(&output, &pieces).expect("joined");
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let read = |path: &Path| demc_data::read_frame(path, &layout).expect("a frame");
    let (before, after) = (read(&scene), read(&output));
    assert!(before.color == after.color && before.features == after.features);
    assert!(before.reference == after.reference && before.mask == after.mask);
}

#[test]
fn every_lossless_compression_stays_and_others_become_zip() {
    let files = Files::new();
    for (given, expected) in [
        (Compression::Uncompressed, Compression::Uncompressed),
        (Compression::RLE, Compression::RLE),
        (Compression::ZIP1, Compression::ZIP1),
        (Compression::PIZ, Compression::PIZ),
        (Compression::PXR24, Compression::PXR24),
        (Compression::B44, Compression::ZIP16),
        (Compression::DWAA(None), Compression::ZIP16),
    ] {
        let (a, output) = (files.path("a.exr"), files.path("out.exr"));
        write_file(&a, vec![header(None, (37, 45), rgb_kinds(), given)]);
        joined(&output, &[(None, &a), (Some("x"), &a)]).expect("joined");
        assert_eq!(headers(&output)[0].compression, expected);
        let (before, after) = (planes(&a), planes(&output));
        for (i, (_, plane)) in before.iter().enumerate() {
            assert!(*plane == after[i].1 && *plane == after[i + 3].1, "{given}");
        }
    }
}

#[test]
fn attributes_of_the_first_file_win_and_the_others_fill_gaps() {
    let files = Files::new();
    let (a, b) = (files.path("a.exr"), files.path("b.exr"));
    let new = || header(None, (37, 45), rgb_kinds(), Compression::ZIP16);
    let mut first = placed(new(), (3, -4), display());
    first.own_attributes.software_name = Some("another".into());
    first.own_attributes.layer_name = Some("beauty".into());
    let second = placed(with_attributes(new()), (3, -4), display());
    let mut expected = second.clone();
    // It is read as a standard attribute.
    let name = exr::meta::attribute::Text::from("keyCode");
    let key_code = expected.own_attributes.other.remove(&name);
    assert!(key_code.is_some());
    write_file(&a, vec![first]);
    write_file(&b, vec![second]);
    let output = files.path("out.exr");
    let merged = joined(&output, &[(None, &a), (Some("b"), &b)]).expect("joined");
    assert!(
        merged.conflicts.contains(&"software".to_owned()),
        "{merged:?}"
    );

    let [header] = &headers(&output)[..] else {
        panic!("one part")
    };
    let own = &header.own_attributes;
    assert_eq!(own.software_name, Some("another".into()));
    assert_eq!(own.layer_name, Some("beauty".into()));
    assert_eq!(own.other, expected.own_attributes.other);
    assert_eq!(own.white_luminance, Some(120.0));
    let key_code = own.film_key_code.expect("read whole");
    assert_eq!((key_code.count, key_code.perforations_per_count), (4, 7));
    let shared = &header.shared_attributes;
    assert_eq!(
        shared.chromaticities,
        expected.shared_attributes.chromaticities
    );
    assert_eq!(shared.time_code, expected.shared_attributes.time_code);
    assert_eq!(shared.display_window, display());
    assert_eq!(header.own_attributes.layer_position.0, 3);

    let bytes = fs::read(&output).expect("readable");
    joined(&output, &[(None, &a), (Some("b"), &b)]).expect("joined");
    assert_eq!(
        fs::read(&output).expect("readable"),
        bytes,
        "the same file twice"
    );
}

#[test]
fn parts_become_prefixes() {
    let files = Files::new();
    let path = files.path("parts.exr");
    let layer = |name| part(Some(name), (2, 1), ZIP, named([("R", half([1.0, 2.0]))]));
    write_parts(&path, (2, 1), vec![layer("beauty"), layer("mist")]);
    let output = files.path("out.exr");
    let merged = joined(&output, &[(Some("v"), &path)]).expect("joined");
    assert_eq!(merged.channels, ["v.beauty.R", "v.mist.R"]);
    assert_eq!(headers(&output).len(), 1);
    assert_eq!(headers(&output)[0].own_attributes.layer_name, None);
}

#[test]
fn clashing_names_are_refused() {
    let files = Files::new();
    let a = files.small("a.exr", &["R", "G"]);
    let b = files.small("b.exr", &["G"]);
    files.refused(&[(None, &a), (None, &b)], "a.exr and ");
    files.refused(&[(None, &a), (None, &b)], "b.exr both give a channel G");
    let long = "n".repeat(300);
    files.refused(&[(Some(&long), &a)], "would have 302 bytes");
    files.refused(&[], "no files");
}

#[test]
fn other_sizes_and_windows_are_refused() {
    let files = Files::new();
    let a = files.small("a.exr", &["R"]);
    let b = files.path("b.exr");
    write(&b, (4, 2), named([("X", half([0.0; 8]))]));
    files.refused(&[(None, &a), (None, &b)], "a.exr covers 2x2, channel X of ");
    files.refused(&[(None, &a), (None, &b)], "b.exr covers 4x2");

    let moved = placed(
        header(None, (2, 2), rgb_kinds(), Compression::ZIP16),
        (5, -1),
        IntegerBounds::from_dimensions((9, 9)),
    );
    write_file(&b, vec![moved]);
    files.refused(&[(None, &a), (Some("b"), &b)], "b.exr covers 2x2+5-1");

    let parts = files.path("parts.exr");
    let small = part(Some("proxy"), (1, 1), ZIP, named([("R", half([1.0]))]));
    let large = part(Some("beauty"), (2, 1), ZIP, named([("R", half([1.0; 2]))]));
    write_parts(&parts, (2, 1), vec![large, small]);
    files.refused(&[(None, &parts)], "channel proxy.R of ");
}

#[test]
fn damaged_inputs_leave_no_output() {
    let files = Files::new();
    let a = files.small("a.exr", &["R"]);
    let b = files.path("b.exr");
    let scene = fs::read(sample().join("train/col-spaceship-0.exr")).expect("readable");
    fs::write(&b, &scene[..scene.len() / 2]).expect("writable");
    let whole = sample().join("train/col-ashtray-0.exr");
    files.refused(
        &[(None, &whole), (Some("b"), &b)],
        "not a readable OpenEXR file",
    );
    files.refused(
        &[(None, &a), (None, &files.path("none.exr"))],
        "cannot read",
    );
}

#[test]
fn a_file_without_channels_is_refused() {
    let files = Files::new();
    let path = files.small("empty.exr", &["R"]);
    // The crate writes no file without channels, so the list is cut from the header.
    let bytes = fs::read(&path).expect("readable");
    let list = b"channels\0chlist\0";
    let found = bytes.windows(list.len()).position(|w| w == list);
    let start = found.expect("a list") + list.len();
    let size = u32::from_le_bytes(bytes[start..start + 4].try_into().expect("four bytes"));
    let end = start + 4 + size as usize;
    let empty = [1, 0, 0, 0, 0];
    fs::write(&path, [&bytes[..start], &empty, &bytes[end..]].concat()).expect("writable");
    files.refused(&[(None, &path)], "at least one channel is required");
}
