//! The albedo filter: a second network denoises the albedo of the first hit before the first one
//! sees it.
//!
//! The filter sees the padded image with the frame's features, as in the ONNX graph and in Python. Its
//! colour is the albedo, clamped to 0 to 1, without a factor and without test-time augmentation.

use std::sync::Arc;

use demc_data::Frame;
use demc_data::image::frame::MAX_ALBEDO;
use demc_data::image::frame::TEXTURES;
use demc_model::config::COLOR_CHANNELS;
use rayon::prelude::*;

use super::input::FrameInput;
use super::progress::{DenoiseObserver, DenoiseProgress, unobserved};
use crate::Bundle;
use crate::ensemble::Ensemble;
use crate::error::DenoiseError;
use crate::padding::Padding;
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
        if let Some(filter) = &self.bundle.albedo_filter {
            let filtered = self.filtered(filter, self.padded(), tiling, observer)?;
            self.albedo = filtered.map(Arc::from);
        }
        Ok(())
    }

    /// The filter's image of the albedo, cropped or padded to `size`; `None` for a constant albedo.
    fn filtered(
        &self,
        filter: &Bundle,
        size: Padding,
        tiling: &Tiling,
        observer: &mut DenoiseObserver,
    ) -> Result<Option<Vec<f32>>, DenoiseError> {
        let frame = self.frame;
        let pixels = frame.width * frame.height;
        let albedo = &frame.features[TEXTURES * pixels..][..COLOR_CHANNELS * pixels];
        let is_constant = |plane: &[f32]| plane.iter().all(|value| *value == plane[0]);
        if albedo.chunks_exact(pixels).all(is_constant) {
            return Ok(None);
        }
        let clamp = |value: &f32| value.clamp(0.0, MAX_ALBEDO);
        let color: Vec<f32> = albedo.par_iter().map(clamp).collect();
        let own = FrameInput {
            color: &color,
            // The filter takes the positions of the network ([`BundleMeta::filter_problem`]).
            ..FrameInput::with_positions(filter, frame, self.positions)?
        };
        let tiles = filter
            .tiles(frame.height, frame.width, &tiling.exact(), Ensemble::One)
            .map_err(|source| DenoiseError::Memory {
                name: frame.name.clone(),
                source,
            })?;
        let mut filtered = own.denoise_into(size, &tiles, &mut |progress| {
            let share = 0.0;
            observer(DenoiseProgress { share, ..progress })
        })?;
        let rows = filtered.par_chunks_mut(size.width).enumerate();
        rows.for_each(|(row, filtered)| {
            let first = (row % size.height).min(frame.height - 1) * frame.width;
            let albedo = [0, 1, 2].map(|c| &color[c * pixels + first..][..frame.width]);
            for (column, value) in filtered.iter_mut().enumerate() {
                let column = column.min(frame.width - 1);
                // Without a surface there is nothing to filter; neighbours would bleed in.
                *value = if albedo.iter().any(|channel| channel[column] > 0.0) {
                    value.min(MAX_ALBEDO)
                } else {
                    0.0
                };
            }
        });
        Ok(Some(filtered))
    }
}

impl Bundle {
    /// The albedo of the first hit as this bundle, which is an albedo filter, returns it: what the
    /// network of a bundle with this [`albedo_filter`](Self::albedo_filter) sees. `None` if the
    /// frame's albedo is constant: it is not filtered.
    ///
    /// # Shapes
    /// Returns planar `[3, H, W]`, from 0 to 1.
    ///
    /// # Errors
    /// Buffers of other sizes; no memory for the smallest tile; a failed device; an output that is
    /// not finite.
    pub fn filtered_albedo(&self, frame: &Frame) -> Result<Option<Vec<f32>>, DenoiseError> {
        let input = FrameInput::new(self, frame)?;
        input.filtered(self, input.padding, &Tiling::default(), &mut unobserved)
    }
}
