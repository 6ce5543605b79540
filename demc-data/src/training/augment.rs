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
mod tests {
    use super::*;

    const NONE: Variation = Variation {
        crop: None,
        flip_x: false,
        flip_y: false,
        transpose: false,
        rgb: [0, 1, 2],
        exposure: 1.0,
        axes: [0, 1, 2],
        mirrored: [false; 3],
        noise: None,
    };
    const TURNS: Augment = Augment {
        flip: true,
        transpose: true,
        rgb: false,
        exposure: false,
        axes: false,
        crop: false,
        noise: false,
    };

    fn turned(orientation: Variation) -> Vec<f32> {
        let mut planes = vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
        orientation.turn(&mut planes, 3);
        planes
    }

    #[test]
    fn each_part_moves_pixels_as_its_name_says() {
        assert_eq!(turned(NONE), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
        assert_eq!(
            turned(Variation {
                flip_x: true,
                ..NONE
            }),
            [3.0, 2.0, 1.0, 6.0, 5.0, 4.0, 9.0, 8.0, 7.0]
        );
        assert_eq!(
            turned(Variation {
                flip_y: true,
                ..NONE
            }),
            [7.0, 8.0, 9.0, 4.0, 5.0, 6.0, 1.0, 2.0, 3.0]
        );
        assert_eq!(
            turned(Variation {
                transpose: true,
                ..NONE
            }),
            [1.0, 4.0, 7.0, 2.0, 5.0, 8.0, 3.0, 6.0, 9.0]
        );
    }

    #[test]
    fn off_never_turns_and_on_reaches_all_eight_orientations() {
        let drawn = |augment: Augment| (0..200).map(move |position| augment.draw(1, 2, position));
        assert!(drawn(Augment::default()).all(|orientation| orientation == NONE));
        let mut images: Vec<Vec<f32>> = drawn(TURNS).map(turned).collect();
        images.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        images.dedup();
        assert_eq!(images.len(), 8);
        assert!(
            drawn(Augment {
                flip: false,
                ..TURNS
            })
            .all(|v| !v.flip_x && !v.flip_y && v.rgb == NONE.rgb && v.exposure == 1.0)
        );
    }

    #[test]
    fn every_order_of_rgb_and_the_whole_range_of_exposures_are_drawn() {
        let all = Augment::ALL;
        let drawn: Vec<Variation> = (0..300).map(|position| all.draw(1, 2, position)).collect();
        for order in ORDERS {
            let count = drawn.iter().filter(|v| v.rgb == order).count();
            // 50 expected, standard deviation 6.5.
            assert!((20..80).contains(&count), "{order:?}: {count}");
        }
        let exposures = drawn.iter().map(|v| v.exposure);
        let (least, most) = exposures.fold((f32::MAX, 0.0), |(a, b): (f32, f32), e| {
            (a.min(e), b.max(e))
        });
        assert!((0.5..0.55).contains(&least) && (1.8..2.0).contains(&most));
    }

    #[test]
    fn every_axis_permutation_and_mirroring_is_drawn() {
        let axes = Augment {
            axes: true,
            ..Augment::default()
        };
        let drawn: Vec<_> = (0..2400)
            .map(|position| axes.draw(1, 2, position))
            .map(|v| (v.axes, v.mirrored))
            .collect();
        for order in ORDERS {
            for bits in 0..8 {
                let mirrored = [0, 1, 2].map(|axis| bits >> axis & 1 != 0);
                let count = drawn.iter().filter(|v| **v == (order, mirrored)).count();
                // 50 expected, standard deviation 7.
                assert!((20..85).contains(&count), "{order:?} {mirrored:?}: {count}");
            }
        }
    }

    /// A patch of 32 pixels in a scene of 36 x 34 has five possible rows and three possible
    /// columns.
    #[test]
    fn crops_are_everywhere_in_the_scene_and_in_it() {
        let patch = Patch {
            scene: 0,
            y: 4,
            x: 2,
        };
        let crop = Augment {
            crop: true,
            ..Augment::default()
        };
        let mut counts = [[0; 3]; 5];
        for position in 0..1500 {
            let placed = crop.draw(1, 0, position).place(patch, (36, 34), 32);
            counts[placed.y as usize][placed.x as usize] += 1;
        }
        // 100 expected each, standard deviation 10.
        let all = counts.iter().flatten();
        assert!(all.clone().all(|n| (60..140).contains(n)), "{counts:?}");
        assert_eq!(NONE.place(patch, (36, 34), 32), patch);
    }

    /// Enabling other augmentations does not change the draws of one augmentation.
    #[test]
    fn augmentations_are_independent_of_each_other() {
        let all = Augment::ALL;
        for position in 0..50 {
            let (both, turns) = (all.draw(7, 0, position), TURNS.draw(7, 0, position));
            assert_eq!(turned(both), turned(turns));
        }
    }

    #[test]
    fn augment_lists_survive_toml_and_errors_name_the_choices() {
        #[derive(Debug, PartialEq, Serialize, Deserialize)]
        struct DataTable {
            augment: Augment,
        }
        let none = Augment::default();
        for (text, expected) in [
            ("augment = []", none),
            ("augment = [\"flip\"]", Augment { flip: true, ..none }),
            ("augment = [\"transpose\", \"flip\"]", TURNS),
            ("augment = [\"rgb\"]", Augment { rgb: true, ..none }),
            (
                "augment = [\"exposure\", \"rgb\"]",
                Augment {
                    rgb: true,
                    exposure: true,
                    ..none
                },
            ),
            (
                "augment = [\"noise\", \"crop\"]",
                Augment {
                    crop: true,
                    noise: true,
                    ..none
                },
            ),
            (
                "augment = [\"flip\", \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\", \"noise\"]",
                Augment::ALL,
            ),
        ] {
            let table: DataTable = toml::from_str(text).expect(text);
            assert_eq!(table.augment, expected, "{text}");
            let written = toml::to_string(&table).expect("plain data");
            assert_eq!(
                toml::from_str::<DataTable>(&written).expect("its own"),
                table
            );
        }
        for text in [
            "augment = true",
            "augment = false",
            "augment = [\"rotate\"]",
        ] {
            let error = toml::from_str::<DataTable>(text).expect_err("not a list of names");
            assert_eq!(
                error.message(),
                "augment must be a list such as [\"flip\", \"transpose\"]; its names are \"flip\", \
                 \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\" and \"noise\""
            );
        }
    }
}
