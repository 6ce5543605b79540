//! Denoised images in the layout of their input: only the colour changes.

use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;

use crate::support::files::{header, placed, rgb_kinds, scene_kinds, tiled, write_file};
use crate::support::rewritten::{
    PIXELS, SIZE, assert_carried, changes, color, display, headers, method, planes, rewrite,
    with_attributes,
};
use crate::support::{layout, sample};
use demc_data::image::exr::ExrFile;
use demc_data::image::{frame, rewrite as rewriting};
use demc_data::{Change, Compression, WriteOptions, Written, write_denoised};
use exr::math::RoundingMode;
use exr::meta::BlockDescription;
use exr::meta::attribute::LevelMode;
use exr::prelude::{Compression as Method, LineOrder, SampleType};

#[test]
fn every_compression_and_block_shape_is_carried_over() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    for compression in Compression::ALL {
        for tiles in [false, true] {
            let method = method(compression);
            let mut part = header(None, SIZE, scene_kinds(), method);
            if tiles {
                part = tiled(part, LevelMode::Singular, RoundingMode::Down);
            }
            write_file(&input, vec![part]);
            let what = format!("{compression}, tiles {tiles}");
            let written = rewrite(&input, &output, &WriteOptions::default());
            assert_carried(&input, &output, &what);
            let (before, after) = (&headers(&input)[0], &headers(&output)[0]);
            assert_eq!(before.blocks, after.blocks, "{what}");
            let changed = Change::Compression {
                part: String::new(),
                from: compression.name(),
                to: Compression::Zip,
            };
            if changes(method) {
                assert_eq!(after.compression, Method::ZIP16, "{what}");
                assert_eq!(written.changes, [changed], "{what}");
            } else {
                assert_eq!(before, after, "{what}");
                assert_eq!(written, Written::default(), "{what}");
            }
        }
    }
}

/// The image has several batches on one thread and one batch on many. Its blocks also differ in
/// size from the output's.
#[test]
fn threads_and_cached_blocks_do_not_change_the_output() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let size = (700, 400);
    let (layout, color) = (layout(), color(size.0 * size.1));
    let part = |method| header(None, size, scene_kinds(), method);
    let zip = part(Method::ZIP16);
    let upwards = zip.clone().with_encoding(
        Method::ZIP16,
        BlockDescription::ScanLines,
        LineOrder::Decreasing,
    );
    for (part, compression) in [
        (upwards, None),
        (tiled(zip, LevelMode::Singular, RoundingMode::Down), None),
        (part(Method::PIZ), Some(Compression::Zips)),
        (part(Method::ZIP1), Some(Compression::Zip)),
    ] {
        write_file(&input, vec![part]);
        let options = WriteOptions {
            compression,
            ..WriteOptions::default()
        };
        let write = |file: &mut ExrFile| {
            rewriting::rewrite(file, &layout, &color, &output, &options).expect("sound");
            fs::read(&output).expect("just written")
        };
        let open = |threads| ExrFile::open(&input).expect("sound").on_threads(threads);
        let (image, expected) = {
            let mut file = open(1);
            let image = frame::decode_input(&mut file, &layout).expect("sound");
            (image, write(&mut file))
        };
        assert_carried(&input, &output, "one thread");
        for threads in [1, 3, 100] {
            // Memory for no blocks, for some, and for all.
            for room in [0, 5_000_000, usize::MAX] {
                let mut file = open(threads).keeping(&layout.color, room);
                // Twice from one file, which is read again.
                for _ in 0..2 {
                    let again = frame::decode_input(&mut file, &layout).expect("sound");
                    assert!(again == image, "{threads} threads, room {room}");
                    assert!(
                        write(&mut file) == expected,
                        "{threads} threads, room {room}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_lossy_compression_stays_where_there_is_nothing_else_to_lose() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    write_file(
        &input,
        vec![header(None, SIZE, rgb_kinds(), Method::DWAA(Some(20.0)))],
    );
    let written = rewrite(&input, &output, &WriteOptions::default());
    assert_eq!(written.changes, []);
    assert_eq!(headers(&output)[0].compression, Method::DWAA(Some(20.0)));
}

#[test]
fn the_sample_keeps_header_and_channels() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let output = dir.path().join("out.exr");
    for name in ["col-ashtray-0.exr", "col-bathroom-0.exr"] {
        let input = sample().join("train").join(name);
        let pixels = 224 * 224;
        let written = write_denoised(
            &input,
            &layout(),
            &color(pixels),
            &output,
            &WriteOptions::default(),
        )
        .expect("sound");
        assert_eq!(written, Written::default());
        assert_eq!(headers(&input), headers(&output));
        assert_carried(&input, &output, name);
    }
}

#[test]
fn parts_windows_and_attributes_are_the_inputs() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let part = |name, size, kinds, method| with_attributes(header(Some(name), size, kinds, method));
    let ids = vec![("id".to_owned(), SampleType::U32)];
    let depth = vec![("Z".to_owned(), SampleType::F32)];
    let parts = vec![
        placed(
            part("ids", (20, 11), ids, Method::PXR24),
            (5, -7),
            display(),
        ),
        placed(
            part("rgba", SIZE, scene_kinds(), Method::PIZ),
            (-4, 9),
            display(),
        ),
        placed(
            tiled(
                part("depth", SIZE, depth, Method::B44A),
                LevelMode::RipMap,
                RoundingMode::Up,
            ),
            (0, 0),
            display(),
        ),
        placed(
            part("dct", SIZE, rgb_kinds(), Method::DWAB(None)),
            (-4, 9),
            display(),
        ),
    ];
    write_file(&input, parts);
    let mut named = layout();
    let name = |name: &mut String| *name = format!("rgba.{name}");
    named.color.iter_mut().for_each(name);
    let rewritten = write_denoised(
        &input,
        &named,
        &color(PIXELS),
        &output,
        &WriteOptions::default(),
    );
    assert_eq!(rewritten.expect("sound"), Written::default());
    assert_eq!(headers(&input), headers(&output));
    for ((channel, old), (same, new)) in planes(&input).into_iter().zip(planes(&output)) {
        assert_eq!(channel, same);
        let replaced = named.color.contains(&channel.name);
        assert_eq!(old == new, !replaced, "{}", channel.name);
    }
    // Its blocks are copied, including smaller levels: nothing of a part without colour is decoded.
    for part in [0, 2, 3] {
        assert!(blocks(&input, part) == blocks(&output, part));
    }
}

#[test]
fn equal_images_give_equal_bytes() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    for parts in [1, 2] {
        let named = |part| header(Some(["a", "b"][part]), SIZE, scene_kinds(), Method::ZIP16);
        write_file(
            &input,
            (0..parts)
                .map(|part| with_attributes(named(part)))
                .collect(),
        );
        let mut layout = layout();
        if parts == 2 {
            layout
                .color
                .iter_mut()
                .for_each(|name| *name = format!("b.{name}"));
        }
        let bytes = || {
            let options = WriteOptions::default();
            write_denoised(&input, &layout, &color(PIXELS), &output, &options).expect("sound");
            assert_eq!(headers(&input), headers(&output));
            std::fs::read(&output).expect("just written")
        };
        let first = bytes();
        assert!((0..16).all(|_| bytes() == first));
    }
}

fn blocks(path: &Path, part: usize) -> Vec<String> {
    let file = BufReader::new(File::open(path).expect("readable"));
    let chunks = exr::block::read(file, false)
        .and_then(|file| file.all_chunks(false))
        .expect("readable")
        .map(|chunk| chunk.expect("whole"));
    let of_part = chunks.filter(|chunk| chunk.layer_index == part);
    let blocks: Vec<String> = of_part.map(|chunk| format!("{chunk:?}")).collect();
    assert!(!blocks.is_empty());
    blocks
}

#[test]
fn smaller_levels_of_the_colour_are_dropped_and_reported() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    for levels in [LevelMode::MipMap, LevelMode::RipMap] {
        for rounding in [RoundingMode::Down, RoundingMode::Up] {
            let part = header(None, SIZE, scene_kinds(), Method::ZIP16);
            write_file(&input, vec![tiled(part, levels, rounding)]);
            let written = rewrite(&input, &output, &WriteOptions::default());
            let part = String::new();
            assert_eq!(written.changes, [Change::Levels { part }]);
            assert_eq!(
                written.changes[0].to_string(),
                "written without its smaller levels"
            );
            assert_carried(&input, &output, &format!("{levels:?} {rounding:?}"));
        }
    }
}

#[test]
fn lines_keep_their_order_in_the_file() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    for method in [Method::ZIP1, Method::PIZ] {
        let mut part = header(None, SIZE, scene_kinds(), method);
        part.line_order = LineOrder::Decreasing;
        write_file(&input, vec![part]);
        for compression in [None, Some(Compression::Zip), Some(Compression::Dwab)] {
            let options = WriteOptions {
                compression,
                ..WriteOptions::default()
            };
            rewrite(&input, &output, &options);
            assert_eq!(headers(&output)[0].line_order, LineOrder::Decreasing);
            if compression != Some(Compression::Dwab) {
                assert_carried(&input, &output, &format!("{method} to {compression:?}"));
            }
        }
    }
}
