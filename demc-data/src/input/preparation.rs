//! What happens to a whole image before patches or tiles are cut from it: its positions are mapped,
//! and the factor on its radiance is measured. Training and denoising do the same.

use crate::image::frame::FramePlanes;
use crate::image::plane::Plane;
use crate::input::position::{PositionSpace, map_planes};
use crate::input::transfer::Transfer;
use crate::input::transform::exposure_scale;

/// The steps on a whole image; by default none.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Preparation {
    /// What the origin and the unit of positions are.
    pub position: PositionSpace,
    /// The exposure that every image is scaled to.
    pub exposure_level: Option<f32>,
    /// The curve of the colour, which says how an exposure is measured.
    pub transfer: Transfer,
}

impl Preparation {
    /// Maps the positions of an image in place, and returns the factor on its colour and reference,
    /// which is applied to each patch.
    pub(crate) fn apply(self, planes: &mut FramePlanes) -> f32 {
        map_planes(&mut planes.features, self.position);
        let Some(level) = self.exposure_level else {
            return 1.0;
        };
        let color: Vec<f32> = planes.color.iter().flat_map(Plane::to_f32).collect();
        let exposure = self.transfer.exposure(&color, planes.height, planes.width);
        exposure_scale(level, exposure)
    }
}
