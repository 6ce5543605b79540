//! The files of a run directory that describe the run. Its checkpoints have copies of them.

use std::path::Path;

use demc_data::ChannelLayout;

use crate::config::Config;

/// The resolved configuration.
pub const CONFIG: &str = "config.toml";
/// The record of versions, device and data.
pub const RUN: &str = "run.json";
/// The channel layout, if it is not a preset.
pub const LAYOUT: &str = "layout.toml";
/// All of them.
pub const OWN_FILES: [&str; 3] = [CONFIG, RUN, LAYOUT];

/// Whether the bytes of one of [`OWN_FILES`] in a run directory can be used. The record of a run
/// never changes, so that of a checkpoint is preferred.
pub fn is_usable(name: &str, bytes: &[u8]) -> bool {
    let Ok(text) = str::from_utf8(bytes) else {
        return false;
    };
    match name {
        CONFIG => Config::parse(Path::new(CONFIG), text, &[]).is_ok(),
        LAYOUT => toml::from_str::<ChannelLayout>(text).is_ok(),
        _ => false,
    }
}
