//! Rewrites bytes as an EXR file; the output must have the same channels.
#![no_main]

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use demc_data::image::exr::ExrFile;
use demc_data::image::frame::decode_input;
use demc_data::image::rewrite::rewrite;
use demc_data::{ChannelLayout, WriteOptions};
use demc_fuzz::{allow_caught_panics, scratch};
use libfuzzer_sys::fuzz_target;

static DIR: LazyLock<PathBuf> = LazyLock::new(scratch);

fuzz_target!(init: allow_caught_panics(), |bytes: &[u8]| {
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let Ok(file) = ExrFile::parse(Path::new("input.exr"), Cursor::new(bytes)) else {
        return;
    };
    let Some(color) = file.channel(&layout.color[0]) else {
        return;
    };
    let pixels = color.window.width * color.window.height;
    if pixels > 1 << 20 {
        return;
    }
    let names = |file: &[demc_data::image::channel::Channel]| -> Vec<_> {
        file.iter().map(|c| (c.name.clone(), c.window, c.layer.clone())).collect()
    };
    let expected = names(file.channels());
    let output = DIR.join("out.exr");
    let color = vec![0.5; 3 * pixels];
    // As in `demc-infer denoise`, reading keeps decoded blocks for writing; here only some of them.
    let mut file = file.keeping(&layout.color, 4096);
    let _ = decode_input(&mut file, &layout);
    if rewrite(&mut file, &layout, &color, &output, &WriteOptions::default()).is_ok() {
        let mut written = ExrFile::open(&output).expect("what was written is readable");
        assert_eq!(names(written.channels()), expected);
        let planes = written.read(&["R", "G", "B"]).expect("what was written is readable");
        assert!(planes.iter().all(|plane| plane.to_f32().iter().all(|&sample| sample == 0.5)));
    }
});
