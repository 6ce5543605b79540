//! A tile as KPCN denoises it.

use burn::tensor::Tensor;
use demc_data::FEATURES;
use demc_data::input::kpcn::{KpcnInput, LIGHT, radiance_from_light};

use super::input::FrameInput;
use crate::error::DenoiseError;
use crate::padding::PixelRange;

impl FrameInput<'_> {
    /// Denoises one tile with `forward`, which takes light and features.
    ///
    /// # Shapes
    /// Returns `[3, rows, columns]` in linear HDR.
    ///
    /// # Errors
    /// A frame without passes; those of `forward`.
    pub(super) fn light_tile(
        &self,
        [rows, columns]: [&PixelRange; 2],
        forward: impl FnMut([Tensor<4>; 2]) -> Result<Tensor<4>, DenoiseError>,
    ) -> Result<Vec<f32>, DenoiseError> {
        let Some(passes) = &self.frame.passes else {
            let name = self.frame.name.clone();
            return Err(DenoiseError::NoPasses { name });
        };
        let cut = |planes: &[f32]| self.padding.cut(planes, rows.clone(), columns.clone());
        let input = KpcnInput::new(&cut(passes), &cut(&self.frame.features), self.scale);
        let inputs = [
            self.tensor::<LIGHT>(input.light, rows, columns),
            self.tensor::<FEATURES>(input.features, rows, columns),
        ];
        let light = self.read(self.ensemble.mean(inputs, forward)?)?;
        Ok(radiance_from_light(&light, &input.divisor, self.scale))
    }
}
