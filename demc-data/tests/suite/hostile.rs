//! Files that claim more than they hold, unsupported files, and paths that are not files. Each is
//! refused with one line, at once, and without the claimed memory.

use std::fs;
use std::io::Cursor;
use std::path::Path;
use std::process::{Command, Output};

use crate::support::files::{header, placed, rgb_kinds, sample, scene_kinds, tiled, write_file};
use crate::support::layout;
use demc_data::image::channel::Window;
use demc_data::image::exr::ExrFile;
use demc_data::{ChannelLayout, read_frame};
use exr::math::RoundingMode;
use exr::meta::attribute::{IntegerBounds, LevelMode};
use exr::prelude::{Compression as Method, SampleType};

const SIZE: (usize, usize) = (37, 21);

/// The error for a file with these bytes, without its name.
fn refusal(bytes: &[u8]) -> String {
    let path = Path::new("x.exr");
    let read = ExrFile::parse(path, Cursor::new(bytes)).and_then(|mut file| {
        let channels = file.channels().to_vec();
        let names: Vec<&str> = channels.iter().map(|c| c.name.as_str()).collect();
        file.read(&names)
    });
    let message = read
        .map(|_| ())
        .expect_err("it must be refused")
        .to_string();
    assert!(!message.contains('\n'), "{message}");
    let detail = message.strip_prefix("x.exr: not a readable OpenEXR file: ");
    detail.unwrap_or_else(|| panic!("{message}")).to_owned()
}

fn bytes_of(headers: Vec<exr::meta::header::Header>) -> Vec<u8> {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    write_file(&path, headers);
    fs::read(&path).expect("just written")
}

fn replaced(bytes: &[u8], old: &[u8], new: &[u8]) -> Vec<u8> {
    let start = bytes
        .windows(old.len())
        .position(|window| window == old)
        .expect("it is there");
    [&bytes[..start], new, &bytes[start + old.len()..]].concat()
}

/// The stored value of a data window.
fn window(x: (i32, i32), y: (i32, i32)) -> Vec<u8> {
    let attribute = b"dataWindow\0box2i\0\x10\0\0\0".to_vec();
    let sides = [x.0, y.0, x.1, y.1].into_iter().flat_map(i32::to_le_bytes);
    attribute.into_iter().chain(sides).collect()
}

#[test]
fn files_cut_short_at_every_byte_are_refused() {
    for method in [
        Method::Uncompressed,
        Method::PIZ,
        Method::B44A,
        Method::DWAA(None),
    ] {
        let rgb = header(None, (17, 34), rgb_kinds(), method);
        let tiles = tiled(rgb.clone(), LevelMode::Singular, RoundingMode::Down);
        let parts = vec![header(Some("a"), (5, 3), rgb_kinds(), method), {
            header(Some("b"), (5, 3), rgb_kinds(), Method::ZIP1)
        }];
        for whole in [bytes_of(vec![rgb]), bytes_of(vec![tiles]), bytes_of(parts)] {
            (0..whole.len()).for_each(|length| drop(refusal(&whole[..length])));
        }
    }
}

#[test]
fn the_full_size_of_an_image_with_smaller_levels_is_read() {
    for levels in [LevelMode::MipMap, LevelMode::RipMap] {
        for rounding in [RoundingMode::Down, RoundingMode::Up] {
            let part = tiled(
                header(None, SIZE, rgb_kinds(), Method::PIZ),
                levels,
                rounding,
            );
            let bytes = bytes_of(vec![part]);
            let mut file = ExrFile::parse(Path::new("x.exr"), Cursor::new(bytes)).expect("sound");
            let planes = file.read(&["B", "G", "R"]).expect("sound");
            for (channel, plane) in planes.iter().enumerate() {
                let places = (0..SIZE.0 * SIZE.1).map(|i| (i % SIZE.0, i / SIZE.0));
                assert!(
                    plane
                        .to_f32()
                        .into_iter()
                        .eq(places.map(|p| sample(0, channel, p)))
                );
            }
        }
    }
}

#[test]
fn a_window_may_begin_anywhere() {
    for corner in [(-1000, -7), (3, 2_000_000), (-1 << 20, 1 << 20)] {
        let display = IntegerBounds::from_dimensions((8, 8));
        for tiles in [false, true] {
            let mut part = header(None, SIZE, rgb_kinds(), Method::ZIP16);
            if tiles {
                part = tiled(part, LevelMode::Singular, RoundingMode::Down);
            }
            let bytes = bytes_of(vec![placed(part, corner, display)]);
            let mut file = ExrFile::parse(Path::new("x.exr"), Cursor::new(bytes)).expect("sound");
            let expected = Window {
                x: corner.0,
                y: corner.1,
                width: SIZE.0,
                height: SIZE.1,
            };
            assert_eq!(file.channels()[0].window, expected);
            assert_eq!(
                file.read(&["G"]).expect("sound")[0].to_f32()[0],
                sample(0, 1, (0, 0))
            );
        }
    }
}

#[test]
fn kinds_that_are_not_read_are_named_with_those_that_are() {
    let supported =
        "(expected OpenEXR 2 with scan lines or tiles, neither deep nor subsampled, not HTJ2K)";
    let flat = bytes_of(vec![header(None, (4, 4), rgb_kinds(), Method::ZIP1)]);

    let deep = replaced(
        &flat,
        b"type\0string\0\x0d\0\0\0scanlineimage",
        b"type\0string\0\x0c\0\0\0deepscanlineversion\0int\0\x04\0\0\0\x01\0\0\0",
    );
    assert_eq!(
        refusal(&deep),
        format!("deep data not supported yet {supported}")
    );

    let sampled = replaced(
        &flat,
        b"\x01\0\0\0\x01\0\0\0\0compression",
        b"\x02\0\0\0\x02\0\0\0\0compression",
    );
    let message = refusal(&sampled);
    assert_eq!(
        message,
        format!("channel subsampling not supported yet {supported}")
    );

    let newer = replaced(&flat, b"v/1\x01\x02", b"v/1\x01\x03");
    assert!(refusal(&newer).contains("file versions other than 2.0"));

    // A block that is one byte shorter than uncompressed.
    let wavelets = replaced(
        &bytes_of(vec![header(None, (4, 4), rgb_kinds(), Method::PIZ)]),
        b"compression\0compression\0\x01\0\0\0\x04",
        b"compression\0compression\0\x01\0\0\0\x0a",
    );
    let size = wavelets.len() - 96 - 4;
    let shorter = [&wavelets[..size], &[95, 0, 0, 0], &wavelets[size + 4..]].concat();
    assert_eq!(
        refusal(&shorter),
        format!("yet unimplemented compression method: ht j2k 256 compression {supported}")
    );
}

#[test]
fn sizes_that_no_image_has_are_refused() {
    let counted = bytes_of(vec![header(None, (4, 4), rgb_kinds(), Method::ZIP1)]);
    // The block count is optional in a file of one part.
    let flat = replaced(&counted, b"chunkCount\0int\0\x04\0\0\0\x04\0\0\0", b"");
    let own = window((0, 3), (0, 3));
    for (x, y, part) in [
        // Terabytes.
        (
            (0, 1 << 29),
            (0, 1 << 29),
            "its size is 536870913x536870913, not 1x1 to",
        ),
        (
            (0, 32767),
            (0, 4096),
            "its size is 32768x4097, not 1x1 to 32768x32768 with at most 134217728",
        ),
        (
            (i32::MIN, i32::MAX),
            (0, 3),
            "window size exceeding integer maximum",
        ),
        (
            (-1 << 30, 1 << 30),
            (0, 3),
            "window size exceeding integer maximum",
        ),
        // The largest allowed size, with more blocks than bytes.
        ((0, 32767), (0, 4095), "it is cut short: "),
        // An empty size.
        ((0, -1), (0, -1), ""),
    ] {
        let message = refusal(&replaced(&flat, &own, &window(x, y)));
        assert!(message.contains(part), "{message}");
    }
}

#[cfg(unix)]
#[test]
fn a_path_that_is_no_file_is_refused_at_once() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let fifo = dir.path().join("fifo");
    let made = Command::new("mkfifo").arg(&fifo).status();
    assert!(made.expect("mkfifo is there").success());
    for path in [
        fifo.as_path(),
        dir.path(),
        "/dev/null".as_ref(),
        "/dev/zero".as_ref(),
    ] {
        let error = read_frame(path, &layout()).expect_err("no file");
        assert_eq!(error.to_string(), format!("cannot read {}", path.display()));
        let source = std::error::Error::source(&error)
            .expect("a reason")
            .to_string();
        assert_eq!(source, "not a regular file");
        let name = path.to_string_lossy();
        let error = ChannelLayout::resolve(&name)
            .expect_err("no file")
            .to_string();
        assert!(error.contains("neither a preset"), "{error}");
    }
}

#[test]
fn paths_of_every_spelling_lead_to_the_file() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let odd = dir.path().join("a b").join("Küche ☃");
    fs::create_dir_all(&odd).expect("writable");
    let path = odd.join("noisy image.exr");
    write_file(
        &path,
        vec![header(None, (4, 4), scene_kinds(), Method::ZIP1)],
    );
    let roundabout = odd
        .join("..")
        .join("Küche ☃")
        .join(".")
        .join("noisy image.exr");
    for path in [path, roundabout] {
        assert_eq!(
            read_frame(&path, &layout()).expect("sound").name,
            "noisy image"
        );
    }
    let missing = odd.join("../gone.exr");
    let error = read_frame(&missing, &layout())
        .expect_err("not there")
        .to_string();
    assert_eq!(error, format!("cannot read {}", missing.display()));
}

/// A block must not be longer than its pixels. Otherwise overlapping blocks, here one inside each
/// number of the next, would need more memory than the image.
#[test]
fn blocks_longer_than_their_pixels_are_refused() {
    let lines = 64;
    let part = header(None, (1, lines), rgb_kinds(), Method::Uncompressed);
    let mut bytes = bytes_of(vec![part]);
    // Each line has its position, its size and three samples.
    let first = bytes.len() - lines * (4 + 4 + 6);
    for (line, block) in bytes[first..].chunks_exact_mut(14).enumerate() {
        let rest = ((lines - line) * 14 - 8) as u32;
        block[4..8].copy_from_slice(&rest.to_le_bytes());
    }
    assert_eq!(
        refusal(&bytes),
        format!("a block has {} bytes for 6 bytes of pixels", lines * 14 - 8)
    );
}

/// A header of a large image with a full table of blocks, in which every entry points to the same
/// small block.
fn bomb(size: (usize, usize), method: Method, tiles: bool) -> Vec<u8> {
    let mut part = header(None, (1, 1), rgb_kinds(), method);
    if tiles {
        part = tiled(part, LevelMode::Singular, RoundingMode::Down);
    }
    let small = bytes_of(vec![part.clone()]);
    // Position and size precede six bytes of samples.
    let block = &small[small.len() - 6 - if tiles { 20 } else { 8 }..];
    let layer_size = size.into();
    let part = exr::meta::header::Header { layer_size, ..part };
    let (compression, blocks, order) = (part.compression, part.blocks, part.line_order);
    let part = part.with_encoding(compression, blocks, order);
    let mut bytes = small[..8].to_vec();
    part.write(&mut bytes).expect("memory");
    let start = (bytes.len() + 8 * part.chunk_count) as u64;
    bytes.extend(std::iter::repeat_n(start.to_le_bytes(), part.chunk_count).flatten());
    bytes.extend(block);
    bytes
}

#[cfg(unix)]
#[test]
fn a_small_file_takes_little_memory_whatever_it_promises() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("bomb.exr");
    // The limit is 256 MiB; an image of the largest size has 805 MB.
    let inspect = |bytes: &[u8]| -> Output {
        fs::write(&path, bytes).expect("writable");
        let mut shell = Command::new("sh");
        shell.args(["-c", "ulimit -v 262144; exec \"$0\" inspect \"$1\""]);
        shell.arg(env!("CARGO_BIN_EXE_demc-data")).arg(&path);
        shell.output().expect("a shell")
    };
    let refused = |bytes: &[u8], part: &str| {
        let output = inspect(bytes);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert_eq!(error.lines().count(), 1, "{error}");
        assert!(error.contains(part), "{error}");
    };
    let sound = bytes_of(vec![header(None, SIZE, rgb_kinds(), Method::ZIP16)]);
    assert!(inspect(&sound).status.success());

    let largest = (16384, 8192);
    for compression in demc_data::Compression::ALL {
        use demc_data::Compression as Ours;
        let method = match compression {
            Ours::None => Method::Uncompressed,
            Ours::Rle => Method::RLE,
            Ours::Zips => Method::ZIP1,
            Ours::Zip => Method::ZIP16,
            Ours::Piz => Method::PIZ,
            Ours::Pxr24 => Method::PXR24,
            Ours::B44 => Method::B44,
            Ours::B44a => Method::B44A,
            Ours::Dwaa => Method::DWAA(None),
            Ours::Dwab => Method::DWAB(None),
        };
        for tiles in [false, true] {
            // Damaged, or, where so few bytes can hold the pixels, too large for the limit.
            refused(&bomb(largest, method, tiles), "bomb.exr: ");
        }
    }
    refused(&bomb(largest, Method::ZIP16, false), "cannot hold");

    // One tile, with a block that claims 2 GB.
    let tile = bytes_of(vec![tiled(
        header(
            None,
            (1, 1),
            vec![("R".to_owned(), SampleType::F32)],
            Method::ZIP16,
        ),
        LevelMode::Singular,
        RoundingMode::Down,
    )]);
    let mut lying = tile.clone();
    let size = lying.len() - 8;
    lying[size..size + 4].copy_from_slice(&i32::MAX.to_le_bytes());
    refused(
        &lying,
        "it is cut short: a block has 2147483647 bytes, 4 are left",
    );
    let one = replaced(
        &tile,
        &window((0, 0), (0, 0)),
        &window((0, 16383), (0, 8191)),
    );
    let tiles = [16i32.to_le_bytes(), 16i32.to_le_bytes()].concat();
    let all = [16384i32.to_le_bytes(), 8192i32.to_le_bytes()].concat();
    refused(&replaced(&one, &tiles, &all), "cannot hold");
}
