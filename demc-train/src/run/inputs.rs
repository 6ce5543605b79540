//! The files that a run reads, which no command may replace.

use std::path::{Path, PathBuf};

use demc_data::Error;
use demc_data::output::Outputs;
use demc_infer::bundle::locate;

use crate::config::Config;

/// Protects the configuration `files` and what a run of `config` reads: data set, channel layout,
/// initial weights.
///
/// # Errors
/// No data set.
pub fn protect(outputs: &mut Outputs, files: &[PathBuf], config: &Config) -> Result<(), Error> {
    for file in files {
        outputs.protect(file, "the configuration");
    }
    outputs.protect(Path::new(&config.data.layout), "the channel layout");
    for file in config
        .train
        .init
        .iter()
        .flat_map(|init| locate::files(init))
    {
        outputs.protect(&file, "the initial weights");
    }
    outputs.protect_dataset(&config.data.root)
}
