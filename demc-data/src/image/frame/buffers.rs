//! The buffers of an image.

use crate::image::plane::Plane;

/// Number of feature channels: normal xyz, position xyz, texture RGB at the first and at the second
/// vertex (Sec. 3.1).
pub const FEATURES: usize = 12;

/// Index of the first position channel; normals come before it.
pub const POSITIONS: usize = 3;

/// Index of the first texture channel; normals and positions come before it.
pub const TEXTURES: usize = 6;

/// Largest albedo: larger values count as this, in statistics, too. Where a lamp is seen in metal, a renderer
/// may write 90 or 65504, which demodulation would turn into a spike.
pub const MAX_ALBEDO: f32 = 1.0;

/// The feature channels in the network's order.
pub const FEATURE_NAMES: [&str; FEATURES] = [
    "normal.x",
    "normal.y",
    "normal.z",
    "position.x",
    "position.y",
    "position.z",
    "texture1.r",
    "texture1.g",
    "texture1.b",
    "texture2.r",
    "texture2.g",
    "texture2.b",
];

/// An image and its buffers as planar `f32`, in the renderer's own units.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Frame {
    /// The file's name without directory and extension.
    pub name: String,
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Noisy colour `[3, H, W]`: linear HDR radiance, not negative.
    pub color: Vec<f32>,
    /// Features `[12, H, W]` in the order of [`FEATURE_NAMES`], as rendered.
    pub features: Vec<f32>,
    /// Reference colour `[3, H, W]`, if the layout names it and the file has it.
    pub reference: Option<Vec<f32>>,
    /// Share of a pixel's camera rays that hit a surface `[H, W]`, if the layout names it and the
    /// file has it.
    pub mask: Option<Vec<f32>>,
    /// Alpha of the colour `[H, W]`, if the layout names it and the file has it.
    pub alpha: Option<Vec<f32>>,
    /// The passes `[20, H, W]` in the order of [`PASSES`](crate::input::kpcn::PASSES), for KPCN; the depth
    /// is divided by its largest value.
    pub passes: Option<Vec<f32>>,
    /// Number of negative samples of colour, its parts, and the reference that were set to 0.
    pub clamped: usize,
}

impl Frame {
    /// A frame without reference, mask, and alpha. Its buffers are checked when it is denoised.
    ///
    /// # Shapes
    /// `color` `[3, H, W]` in linear radiance, `features` `[12, H, W]` in the order of
    /// [`FEATURE_NAMES`].
    pub fn new(
        name: impl Into<String>,
        width: usize,
        height: usize,
        color: Vec<f32>,
        features: Vec<f32>,
    ) -> Self {
        Self {
            name: name.into(),
            width,
            height,
            color,
            features,
            reference: None,
            mask: None,
            alpha: None,
            passes: None,
            clamped: 0,
        }
    }
}

/// An image's checked buffers in the precision of the file.
#[derive(Debug, Clone, PartialEq)]
pub struct FramePlanes {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Noisy colour: 3 planes.
    pub color: Vec<Plane>,
    /// Features: 12 planes.
    pub features: Vec<Plane>,
    /// Reference colour: 3 planes.
    pub reference: Option<Vec<Plane>>,
    /// Share of the camera rays that hit a surface.
    pub mask: Option<Plane>,
    /// Alpha of the colour.
    pub alpha: Option<Plane>,
    /// The passes, for KPCN: 20 planes, as in [`Frame`].
    pub passes: Option<Vec<Plane>>,
    /// Both parts of the reference, for KPCN: 6 planes.
    pub reference_passes: Option<Vec<Plane>>,
    /// Number of negative samples of colour, its parts, and the reference that were set to 0.
    pub clamped: usize,
    /// Factor on colour and reference before the network ([`Preparation`](crate::input::preparation::Preparation)).
    pub exposure_scale: f32,
}

/// Whether reference, or mask and alpha are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Presence {
    /// It is not read.
    Skip,
    /// It is read if the layout names it and the file has it.
    IfPresent,
    /// It is read if the layout names it; a file without it is refused.
    Required,
}

impl FramePlanes {
    /// Memory of all samples in bytes.
    pub fn bytes(&self) -> usize {
        let radiance = self.color.iter().chain(self.reference.iter().flatten());
        radiance
            .chain(&self.features)
            .chain(&self.mask)
            .chain(&self.alpha)
            .chain(self.passes.iter().flatten())
            .chain(self.reference_passes.iter().flatten())
            .map(Plane::bytes)
            .sum()
    }
}
