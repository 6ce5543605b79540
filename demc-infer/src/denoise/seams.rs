//! The error of a halo below the exact one, measured in small windows at seams that are denoised
//! again with the exact halo.

use demc_model::DOWNSAMPLING;
use demc_model::metrics::rel_mse_image;

use super::input::FrameInput;
use super::progress::{DenoiseObserver, DenoiseProgress};
use crate::error::DenoiseError;
use crate::padding::{Padding, PixelRange};
use crate::tiles::{EXACT_HALO, Span, Tiles};

/// Side of a window in pixels, a multiple of 32.
const WINDOW: usize = 64;

/// Largest number of windows, spread evenly over the seams.
const WINDOWS: usize = 4;

/// Difference between an image from tiles with a small halo and the exact one, at seams.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeamError {
    /// RelMSE (Eq. 5) over the windows' pixels, with the exact image as reference.
    pub relmse: f64,
    /// Largest difference of a value, relative to the largest exact value in its window.
    pub largest: f64,
    /// Number of compared windows of 64x64 pixels.
    pub windows: usize,
}

impl FrameInput<'_> {
    /// Denoises windows at some seams exactly and compares; `None` without seams.
    pub(super) fn seam_error(
        &self,
        tiles: &Tiles,
        color_hdr: &[f32],
        observer: &mut DenoiseObserver,
    ) -> Result<Option<SeamError>, DenoiseError> {
        let windows = windows(tiles, self.padding);
        let mut error = SeamError {
            relmse: 0.0,
            largest: 0.0,
            windows: windows.len(),
        };
        for (rows, columns) in &windows {
            let tile = self.tile([&rows.read, &columns.read], observer, at_end(tiles))?;
            let image = |range: &Span, side: usize| range.core.start..range.core.end.min(side);
            let (y, x) = (
                image(rows, self.padding.height),
                image(columns, self.padding.width),
            );
            let within = Padding {
                height: rows.read.len(),
                width: columns.read.len(),
                unit: 1,
            };
            let inside = |range: &PixelRange, span: &Span| {
                range.start - span.read.start..range.end - span.read.start
            };
            let exact = within.cut(&tile, inside(&y, rows), inside(&x, columns));
            let found = self.padding.cut(color_hdr, y, x);
            let largest = |values: &mut dyn Iterator<Item = f32>| values.fold(0.0, f32::max);
            let difference = largest(&mut found.iter().zip(&exact).map(|(a, b)| (a - b).abs()));
            let scale = largest(&mut exact.iter().copied()).max(f32::MIN_POSITIVE);
            error.relmse += rel_mse_image(&found, &exact) / windows.len() as f64;
            error.largest = error.largest.max(f64::from(difference / scale));
        }
        Ok((!windows.is_empty()).then_some(error))
    }
}

/// The progress of an image whose tiles are all computed.
fn at_end(tiles: &Tiles) -> impl Fn(f64) -> DenoiseProgress {
    let tiles = tiles.count();
    move |_| DenoiseProgress {
        tile: tiles - 1,
        tiles,
        share: 1.0,
    }
}

/// Windows around the crossings of row and column seams; an axis without seams uses its middle.
fn windows(tiles: &Tiles, padding: Padding) -> Vec<(Span, Span)> {
    let sides = (padding.padded_height(), padding.padded_width());
    let rows = seam_spans(&tiles.rows, sides.0);
    let columns = seam_spans(&tiles.columns, sides.1);
    if tiles.count() == 1 {
        return Vec::new();
    }
    let count = rows.len().max(columns.len()).min(WINDOWS);
    let pick = |spans: &[Span], i: usize| spans[i * spans.len() / count].clone();
    (0..count)
        .map(|i| (pick(&rows, i), pick(&columns, i)))
        .collect()
}

/// Windows over the seams of an axis of `length` pixels, each with the exact halo.
fn seam_spans(spans: &[Span], length: usize) -> Vec<Span> {
    let middle = length / 2 / DOWNSAMPLING * DOWNSAMPLING;
    let seams = match spans {
        [_] => vec![middle],
        _ => spans[1..].iter().map(|span| span.core.start).collect(),
    };
    seams
        .into_iter()
        .map(|seam| {
            let core = seam.saturating_sub(WINDOW / 2)..(seam + WINDOW / 2).min(length);
            let read = core.start.saturating_sub(EXACT_HALO)..(core.end + EXACT_HALO).min(length);
            Span { core, read }
        })
        .collect()
}
