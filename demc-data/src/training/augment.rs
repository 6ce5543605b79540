//! Augmentations: random changes to a training patch, drawn for each patch of each epoch. The paper
//! names none (Sec. 4.2), so its preset has none.
//!
//! - Flips and transposes move pixels. Normals and positions are world-space values, so they move
//!   with their pixel and keep their numbers.
//! - Axes: the direction that points up differs between renderers (y or z). This augmentation
//!   permutes and mirrors the world axes, for normals and positions alike.
//! - RGB applies one permutation of red, green and blue to colour, textures and reference.
//! - Exposure applies one factor to colour and reference; light transport is linear in both.
//! - A crop is a patch that need not lie on the grid. The network halves its input five times, and
//!   patches on the grid are always halved at the same pixels.
//! - Noise takes the noise of other pixels of the same surface ([`crate::training::resample`]).

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use crate::seed::{RandomStream, generator};
use crate::training::patch::Patch;

/// Exposures are drawn between minus and plus this many stops (factors of 2); ours.
const EXPOSURE_STOPS: f32 = 1.0;

/// The permutations of three, for colour channels and world axes.
const ORDERS: [[usize; 3]; 6] = [
    [0, 1, 2],
    [0, 2, 1],
    [1, 0, 2],
    [1, 2, 0],
    [2, 0, 1],
    [2, 1, 0],
];

/// Which augmentations are drawn. In a configuration: a list of `"flip"`, `"transpose"`, `"rgb"`,
/// `"exposure"`, `"axes"`, `"crop"` and `"noise"`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "AugmentList", into = "AugmentList")]
pub struct Augment {
    /// Mirror left and right, and independently top and bottom, each half of the time.
    pub flip: bool,
    /// Swap rows and columns half of the time.
    pub transpose: bool,
    /// Permute red, green and blue of colour, textures and reference, each order equally often.
    pub rgb: bool,
    /// Multiply colour and reference by `2^u`, u uniform from -1 to 1.
    pub exposure: bool,
    /// Permute and mirror the world's axes in normals and positions, each of the 48 ways equally
    /// often.
    pub axes: bool,
    /// Cut the patch anywhere in its scene, not on the grid.
    pub crop: bool,
    /// Give pixels the noise of similar pixels nearby ([`crate::training::resample`]).
    pub noise: bool,
}

/// The configuration's value of `augment`.
#[derive(Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "augment must be a list such as [\"flip\", \"transpose\"]; its names are \"flip\", \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\" and \"noise\""
)]
enum AugmentList {
    Names(Vec<Augmentation>),
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Augmentation {
    Flip,
    Transpose,
    Rgb,
    Exposure,
    Axes,
    Crop,
    Noise,
}

impl Augment {
    /// All augmentations.
    pub const ALL: Self = Self {
        flip: true,
        transpose: true,
        rgb: true,
        exposure: true,
        axes: true,
        crop: true,
        noise: true,
    };

    fn pairs(self) -> [(Augmentation, bool); 7] {
        [
            (Augmentation::Flip, self.flip),
            (Augmentation::Transpose, self.transpose),
            (Augmentation::Rgb, self.rgb),
            (Augmentation::Exposure, self.exposure),
            (Augmentation::Axes, self.axes),
            (Augmentation::Crop, self.crop),
            (Augmentation::Noise, self.noise),
        ]
    }
}

impl From<AugmentList> for Augment {
    fn from(AugmentList::Names(names): AugmentList) -> Self {
        let has = |name| names.contains(&name);
        Self {
            flip: has(Augmentation::Flip),
            transpose: has(Augmentation::Transpose),
            rgb: has(Augmentation::Rgb),
            exposure: has(Augmentation::Exposure),
            axes: has(Augmentation::Axes),
            crop: has(Augmentation::Crop),
            noise: has(Augmentation::Noise),
        }
    }
}

impl From<Augment> for AugmentList {
    fn from(augment: Augment) -> Self {
        let enabled = augment.pairs().into_iter().filter(|(_, on)| *on);
        Self::Names(enabled.map(|(name, _)| name).collect())
    }
}

/// The random changes drawn for one patch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Variation {
    /// Position of the patch in its scene, if it is not on the grid: vertical and horizontal, from
    /// 0 to below 1.
    crop: Option<[f64; 2]>,
    flip_x: bool,
    flip_y: bool,
    transpose: bool,
    /// The channels of the image that become red, green and blue.
    pub rgb: [usize; 3],
    /// Factor on colour and reference.
    pub exposure: f32,
    /// The world axes that become x, y and z.
    pub axes: [usize; 3],
    /// Which of x, y and z are then mirrored.
    pub mirrored: [bool; 3],
    /// Seed of the new noise, if the noise is replaced.
    pub noise: Option<u64>,
}

impl Augment {
    /// Draws the changes to the patch at `position` of `epoch`.
    pub fn draw(self, seed: u64, epoch: u64, position: u64) -> Variation {
        let mut rng = generator(RandomStream::Augment, seed, epoch, position);
        // Everything is drawn in any case: disabling one augmentation does not change the others.
        let bits = rng.next_u32();
        let order = ORDERS[rng.random_range(0..ORDERS.len())];
        let stops = rng.random_range(-EXPOSURE_STOPS..EXPOSURE_STOPS);
        let noise = rng.next_u64();
        let crop = [rng.random(), rng.random()];
        let axes = ORDERS[rng.random_range(0..ORDERS.len())];
        let mirrored = rng.random();
        Variation {
            crop: self.crop.then_some(crop),
            flip_x: self.flip && bits & 1 != 0,
            flip_y: self.flip && bits & 2 != 0,
            transpose: self.transpose && bits & 4 != 0,
            rgb: if self.rgb { order } else { ORDERS[0] },
            exposure: if self.exposure { stops.exp2() } else { 1.0 },
            axes: if self.axes { axes } else { ORDERS[0] },
            mirrored: if self.axes { mirrored } else { [false; 3] },
            noise: self.noise.then_some(noise),
        }
    }
}

impl Variation {
    /// Position of `patch` of `size` in a scene of `height` and `width`, which must be large
    /// enough.
    pub fn place(self, patch: Patch, (height, width): (usize, usize), size: usize) -> Patch {
        let origin = |side: usize, share: f64| ((side - size + 1) as f64 * share) as u32;
        match self.crop {
            None => patch,
            Some([y, x]) => Patch {
                y: origin(height, y),
                x: origin(width, x),
                ..patch
            },
        }
    }

    /// Flips and transposes square planes in place.
    ///
    /// # Shapes
    /// `planes` is `[N, size, size]`.
    pub fn turn(self, planes: &mut [f32], size: usize) {
        for plane in planes.chunks_exact_mut(size * size) {
            if self.flip_x {
                plane.chunks_exact_mut(size).for_each(<[f32]>::reverse);
            }
            if self.flip_y {
                for y in 0..size / 2 {
                    let (upper, lower) = plane.split_at_mut((size - 1 - y) * size);
                    upper[y * size..][..size].swap_with_slice(&mut lower[..size]);
                }
            }
            if self.transpose {
                for y in 0..size {
                    for x in 0..y {
                        plane.swap(y * size + x, x * size + y);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
