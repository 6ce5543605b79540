//! The albedo filter: a second network denoises the albedo of the first hit before the first one
//! sees it.
//!
//! The filter sees the padded image with the frame's features, as in the ONNX graph and in Python. Its
//! colour is the albedo, clamped to 0 to 1, without a factor and without test-time augmentation.

use std::sync::Arc;

use demc_data::frame::TEXTURES;
use demc_data::transform::MAX_ALBEDO;
use demc_model::config::COLOR_CHANNELS;
use rayon::prelude::*;

use super::{DenoiseError, DenoiseObserver, DenoiseProgress, FrameInput};
use crate::ensemble::Ensemble;
use crate::tiles::Tiling;

impl FrameInput<'_> {
    /// Replaces the albedo of the first hit by the filter's output. A bundle without a filter and a
    /// constant albedo, as of a file that lacks it, change nothing. Pixels with albedo 0 keep it.
    ///
    /// # Errors
    /// The filter's smallest tile does not fit into memory, the device fails, or its output is not
    /// finite.
    pub(super) fn filter_albedo(
        &mut self,
        tiling: &Tiling,
        observer: &mut DenoiseObserver,
    ) -> Result<(), DenoiseError> {
        let frame = self.frame;
        let pixels = frame.width * frame.height;
        let albedo = &frame.features[TEXTURES * pixels..][..COLOR_CHANNELS * pixels];
        let is_constant = |plane: &[f32]| plane.iter().all(|value| *value == plane[0]);
        let Some(filter) = &self.bundle.albedo_filter else {
            return Ok(());
        };
        if albedo.chunks_exact(pixels).all(is_constant) {
            return Ok(());
        }
        let clamp = |value: &f32| value.clamp(0.0, MAX_ALBEDO);
        let color: Vec<f32> = albedo.par_iter().map(clamp).collect();
        let own = FrameInput {
            color: &color,
            // The filter takes the positions of the network ([`BundleMeta::filter_problem`]).
            ..FrameInput::with_positions(filter, frame, self.positions)?
        };
        let tiles = filter.tiles(frame.height, frame.width, &tiling.exact(), Ensemble::One);
        let tiles = tiles.map_err(|source| DenoiseError::Memory {
            name: frame.name.clone(),
            source,
        })?;
        let mut filtered = own.denoise_into(self.padded(), &tiles, &mut |progress| {
            let share = 0.0;
            observer(DenoiseProgress { share, ..progress })
        })?;
        let padded = self.padded();
        let rows = filtered.par_chunks_mut(padded.width).enumerate();
        rows.for_each(|(row, filtered)| {
            let first = (row % padded.height).min(frame.height - 1) * frame.width;
            let albedo = [0, 1, 2].map(|c| &color[c * pixels + first..][..frame.width]);
            for (column, value) in filtered.iter_mut().enumerate() {
                let column = column.min(frame.width - 1);
                // Without a surface there is nothing to filter; neighbours would bleed in.
                *value = match albedo.iter().any(|channel| channel[column] > 0.0) {
                    true => value.min(MAX_ALBEDO),
                    false => 0.0,
                };
            }
        });
        self.albedo = Some(Arc::from(filtered));
        Ok(())
    }
}
