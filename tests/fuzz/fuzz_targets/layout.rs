//! Parses text as a channel layout and writes it again.
#![no_main]

use demc_data::ChannelLayout;
use demc_fuzz::check_message;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    match ChannelLayout::from_toml("layout.toml", text) {
        Ok(layout) => {
            // Bundles store it as JSON.
            let json = serde_json::to_string(&layout).expect("plain data");
            assert_eq!(
                serde_json::from_str::<ChannelLayout>(&json).expect("its own"),
                layout
            );
        }
        Err(error) => check_message(&error, "layout.toml"),
    }
});
