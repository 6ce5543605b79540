//! `--filter`: methods without a network.

use clap::{Args, ValueEnum};
use demc_data::ChannelLayout;
use demc_data::image::exr::ExrFile;

use crate::nfor;

/// A method without a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Filter {
    /// Bitterli et al. 2016: regression on features, with half buffers and variances
    Nfor,
}

impl Filter {
    /// Its name on the command line and in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nfor => "nfor",
        }
    }

    /// The filtered colour of a file, `[3, H, W]`.
    pub fn denoise(self, file: &mut ExrFile, layout: &ChannelLayout) -> anyhow::Result<Vec<f32>> {
        match self {
            Self::Nfor => Ok(nfor::Buffers::read(file, layout)?.denoise()?),
        }
    }
}

/// `--filter`.
#[derive(Args)]
pub struct FilterFlag {
    /// Denoise with a filter instead of a model. It needs the channels that tools/render --passes paper
    /// writes, or those of [passes] in --layout
    #[arg(
        long = "filter",
        value_name = "NAME",
        value_enum,
        // All options of models.
        conflicts_with_all = [
            "path", "patterns", "detail_map", "repair", "choice", "passes", "restore_light", "halo", "tile", "memory", "name",
            "ops", "isa",
        ]
    )]
    pub filter: Option<Filter>,
}
