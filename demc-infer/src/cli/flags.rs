//! Flags that several commands share: model, device, test-time augmentation, tiles.

use std::path::PathBuf;

use clap::Args;
use demc_data::image::exr::MAX_SIDE;
use demc_program::exit::UsageError;
use demc_program::output::Outputs;

use super::record::Record;
use crate::bundle::locate;
use crate::compute::ComputeFlags;
use crate::tiles::EXACT_HALO;
use crate::{Bundle, BundleError, BundleFile, Bundled, Ensemble, Tiles, Tiling, device};

/// `--model`.
#[derive(Args)]
pub struct ModelFlag {
    /// A bundled model (quality or fast), a run directory, a checkpoint directory or an exported file
    #[arg(long = "model", value_name = "MODEL", default_value = Bundled::default().name())]
    path: PathBuf,
}

impl ModelFlag {
    /// The model's name, for a title.
    pub fn name(&self) -> String {
        self.path.display().to_string()
    }

    /// The model's name without directory and extension, for records: one model has one, wherever it lies.
    pub fn short_name(&self) -> String {
        let name = self.path.file_stem().unwrap_or(self.path.as_os_str());
        name.to_string_lossy().into_owned()
    }

    /// Protects the model's files from being replaced.
    pub fn protect(&self, outputs: &mut Outputs) {
        for file in locate::files(&self.path) {
            outputs.protect(&file, "the model");
        }
    }

    pub fn read(&self) -> Result<BundleFile, BundleError> {
        BundleFile::read(&self.path)
    }

    pub fn load_onto(&self, device: &DeviceFlag) -> anyhow::Result<Bundle> {
        let usage = |error: &dyn std::error::Error| UsageError(error.to_string());
        device.compute.apply().map_err(|error| usage(&error))?;
        let device = device::parse(&device.name).map_err(|error| usage(&error))?;
        Ok(self.read()?.into_bundle(&device)?)
    }
}

/// `--device`, `--ops`, `--isa`.
#[derive(Args)]
pub struct DeviceFlag {
    /// Device: flex (CPU, in every build), or ndarray, wgpu[:N], cuda[:N] in builds with that
    /// feature
    #[arg(long = "device", value_name = "DEVICE", default_value = "flex")]
    name: String,
    #[command(flatten)]
    compute: ComputeFlags,
}

/// `--ensemble`.
#[derive(Args)]
pub struct EnsembleFlag {
    /// Test-time augmentation: mean of 1, 4 or 8 passes over flipped (4) and also transposed (8)
    /// copies of the image. Slightly better, and 4 or 8 times slower
    #[arg(long = "ensemble", value_name = "PASSES", default_value = "1")]
    pub passes: Ensemble,
}

/// `--restore-light`.
#[derive(Args)]
pub struct LightFlag {
    /// Whether the output gets the light of the noisy image back, where the network made it darker or
    /// brighter [default: as the model says]
    #[arg(long = "restore-light", value_name = "on|off", value_parser = switch)]
    pub restore_light: Option<bool>,
}

/// `on` or `off`.
fn switch(text: &str) -> Result<bool, &'static str> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("must be on or off"),
    }
}

/// `--halo`, `--tile`, `--memory`.
#[derive(Args)]
pub struct TilingFlags {
    /// Context around each tile, rounded up to a multiple of 32. 192 gives the same result as the
    /// whole image. Less is faster and approximate; the error at seams is measured and printed
    #[arg(long, value_name = "PX", default_value_t = EXACT_HALO as u32,
        value_parser = clap::value_parser!(u32).range(0..=MAX_SIDE as i64))]
    halo: u32,
    /// Longest side of a tile without its halo [default: as memory allows]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(32..))]
    tile: Option<u32>,
    /// Memory for a pass, in addition to the network and the images [default: the available memory]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..1 << 32))]
    memory: Option<u64>,
}

impl TilingFlags {
    /// Adds a halo that changes the result to a record.
    pub fn record(&self, record: &mut Record) {
        if (self.halo as usize) < EXACT_HALO {
            record.add("--halo", self.halo);
        }
    }

    pub fn tiling(&self) -> Tiling {
        Tiling {
            halo: self.halo as usize,
            side: self.tile.map(|side| side as usize),
            memory: self.memory.map(|mib| mib << 20),
        }
    }
}

/// Describes tiles as `3 x 2 tiles of at most 1280x960 pixels with halo 192, 1.41 times the image's
/// pixels`, or as `whole` for one tile.
pub fn describe(tiles: &Tiles, tiling: &Tiling) -> String {
    if tiles.count() == 1 {
        return "whole".into();
    }
    let (height, width) = tiles.largest();
    let (rows, columns) = (tiles.rows.len(), tiles.columns.len());
    let pixels = tiles.computed_pixels() as f64 / tiles.image_pixels() as f64;
    let halo = tiling.halo;
    format!(
        "{columns} x {rows} tiles of at most {width}x{height} pixels with halo {halo}, \
         {pixels:.2} times the image's pixels"
    )
}
