//! Reads bytes as an EXR file: all channels, and the checked buffers of a layout.
#![no_main]

use std::io::Cursor;
use std::path::Path;

use demc_data::ChannelLayout;
use demc_data::image::channel::ChannelType;
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::{FramePlanes, Presence};
use demc_fuzz::{allow_caught_panics, check_message};
use libfuzzer_sys::fuzz_target;

const NAME: &str = "input.exr";

fuzz_target!(init: allow_caught_panics(), |bytes: &[u8]| {
    let open = || ExrFile::parse(Path::new(NAME), Cursor::new(bytes));
    let mut file = match open() {
        Ok(file) => file,
        Err(error) => return check_message(&error, NAME),
    };
    let channels = file.channels().to_vec();
    let names: Vec<&str> = channels.iter().map(|channel| channel.name.as_str()).collect();
    match file.read(&names) {
        Ok(planes) => {
            assert_eq!(planes.len(), channels.len());
            for plane in planes {
                let sizes = channels.iter().map(|c| {
                    let bytes = if c.kind == ChannelType::Half { 2 } else { 4 };
                    c.window.width * c.window.height * bytes
                });
                assert!(sizes.into_iter().any(|size| size == plane.bytes()));
            }
        }
        Err(error) => check_message(&error, NAME),
    }
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let mut file = open().expect("it opened before");
    match FramePlanes::decode(&mut file, &layout, Presence::IfPresent, Presence::IfPresent) {
        Ok(planes) => assert_eq!((planes.color.len(), planes.features.len()), (3, 12)),
        Err(error) => check_message(&error, NAME),
    }
});
