//! The flags that say how an image is cut.

use clap::Args;
use demc_infer::tiles::EXACT_HALO;
use demc_infer::{Tiles, Tiling};

/// `--halo`, `--tile`, `--memory`.
#[derive(Args)]
pub struct TilingFlags {
    /// Pixels around a tile that it reads and does not write, taken up to a multiple of 32: 192 makes tiles equal to the whole
    /// image; fewer are faster, nearly equal, and their error is measured and printed
    #[arg(long, value_name = "PX", default_value_t = EXACT_HALO)]
    halo: usize,
    /// Longest side of a tile, without its halo [default: as memory allows]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(32..))]
    tile: Option<u32>,
    /// Memory for a pass, beside the network and the images [default: what is free]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..1 << 32))]
    memory: Option<u64>,
}

impl TilingFlags {
    /// What they ask for.
    pub fn tiling(&self) -> Tiling {
        Tiling {
            halo: self.halo,
            side: self.tile.map(|side| side as usize),
            memory: self.memory.map(|mib| mib << 20),
        }
    }
}

/// `3 x 2 tiles of at most 1280x960 pixels, halo 192: 1.41 times the pixels`; `whole` for one tile.
pub fn describe(tiles: &Tiles, tiling: &Tiling) -> String {
    if tiles.count() == 1 {
        return "whole".into();
    }
    let (height, width) = tiles.largest();
    let (rows, columns) = (tiles.rows.len(), tiles.columns.len());
    let pixels = tiles.computed_pixels() as f64 / tiles.image_pixels() as f64;
    let halo = tiling.halo;
    format!(
        "{columns} x {rows} tiles of at most {width}x{height} pixels, halo {halo}: {pixels:.2} times the pixels"
    )
}
