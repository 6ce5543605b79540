//! What is changed about a training patch so that it counts as another one, drawn for each patch of each epoch; off in
//! the paper's preset (Sec. 4.2 names none).
//!
//! Flips and transposes move pixels: normals and positions are world-space values of a pixel, so they move with it and
//! keep their numbers. Axes are what makes these numbers: which of them points up, and which way, is a renderer's choice (some say y, some z), so
//! normals and positions may be told in other axes, the same for both. A permutation of red, green and blue is the same for colour, textures and reference, an
//! exposure the same for colour and reference: light transport is linear in both. A crop is a patch of the same scene that
//! need not lie on the grid: the network halves its input five times, and what is on the grid is always halved alike. Noise is drawn anew from the pixels of
//! the same surface ([`crate::resample`]).

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use crate::Patch;
use crate::seed::{Use, generator};

/// An exposure is drawn between minus and plus so many stops (factors of 2); ours.
const EXPOSURE_STOPS: f32 = 1.0;

/// The orders of three: of red, green and blue, or of the world's axes.
const ORDERS: [[usize; 3]; 6] = [
    [0, 1, 2],
    [0, 2, 1],
    [1, 0, 2],
    [1, 2, 0],
    [2, 0, 1],
    [2, 1, 0],
];

/// Which augmentations are drawn. In a configuration: `true` (all), `false`, or a list of `"flip"`, `"transpose"`, `"rgb"`,
/// `"exposure"`, `"axes"`, `"crop"` and `"noise"`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Setting", into = "Setting")]
pub struct Augment {
    /// Mirror left and right, and independently top and bottom, each half of the time.
    pub flip: bool,
    /// Swap rows and columns half of the time.
    pub transpose: bool,
    /// Permute red, green and blue of colour, textures and reference, each order equally often.
    pub rgb: bool,
    /// Multiply colour and reference by `2^u`, u uniform from -1 to 1.
    pub exposure: bool,
    /// Permute and mirror the world's axes in normals and positions, each of the 48 ways equally often.
    pub axes: bool,
    /// Cut the patch anywhere in its scene, not on the grid.
    pub crop: bool,
    /// Give pixels the noise of others nearby that are like them ([`crate::resample`]).
    pub noise: bool,
}

#[derive(Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "augment must be true, false or a list of \"flip\", \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\" and \"noise\""
)]
enum Setting {
    All(bool),
    Some(Vec<Kind>),
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Flip,
    Transpose,
    Rgb,
    Exposure,
    Axes,
    Crop,
    Noise,
}

const KINDS: [Kind; 7] = [
    Kind::Flip,
    Kind::Transpose,
    Kind::Rgb,
    Kind::Exposure,
    Kind::Axes,
    Kind::Crop,
    Kind::Noise,
];

impl Augment {
    fn has(self, kind: Kind) -> bool {
        match kind {
            Kind::Flip => self.flip,
            Kind::Transpose => self.transpose,
            Kind::Rgb => self.rgb,
            Kind::Exposure => self.exposure,
            Kind::Axes => self.axes,
            Kind::Crop => self.crop,
            Kind::Noise => self.noise,
        }
    }

    fn of(kinds: &[Kind]) -> Self {
        Self {
            flip: kinds.contains(&Kind::Flip),
            transpose: kinds.contains(&Kind::Transpose),
            rgb: kinds.contains(&Kind::Rgb),
            exposure: kinds.contains(&Kind::Exposure),
            axes: kinds.contains(&Kind::Axes),
            crop: kinds.contains(&Kind::Crop),
            noise: kinds.contains(&Kind::Noise),
        }
    }
}

impl From<Setting> for Augment {
    fn from(setting: Setting) -> Self {
        match setting {
            Setting::All(true) => Self::of(&KINDS),
            Setting::All(false) => Self::default(),
            Setting::Some(kinds) => Self::of(&kinds),
        }
    }
}

impl From<Augment> for Setting {
    fn from(augment: Augment) -> Self {
        let kinds = KINDS.into_iter().filter(|kind| augment.has(*kind));
        match kinds.collect::<Vec<_>>() {
            none if none.is_empty() => Setting::All(false),
            all if all.len() == KINDS.len() => Setting::All(true),
            some => Setting::Some(some),
        }
    }
}

/// What was drawn for one patch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Variation {
    /// Where the patch is cut, if not on the grid: from top to bottom and from left to right, 0 to below 1.
    crop: Option<[f64; 2]>,
    flip_x: bool,
    flip_y: bool,
    transpose: bool,
    /// Which channel of the image becomes red, green and blue.
    pub rgb: [usize; 3],
    /// Factor on colour and reference.
    pub exposure: f32,
    /// Which axis of the world becomes x, y and z.
    pub axes: [usize; 3],
    /// Which of x, y and z then point the other way.
    pub mirrored: [bool; 3],
    /// What other noise is drawn from, if it is another one.
    pub noise: Option<u64>,
}

impl Augment {
    /// What is changed about the patch at `position` of `epoch`.
    pub fn draw(self, seed: u64, epoch: u64, position: u64) -> Variation {
        let mut rng = generator(Use::Augment, seed, epoch, position);
        // All are drawn, whatever is on: switching one off leaves the others as they were.
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
    /// Where `patch` of `size` is cut in its scene of `height` and `width`, which it fits into.
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

    /// Turns square planes in place.
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
        let all = Augment::of(&KINDS);
        let drawn: Vec<Variation> = (0..300).map(|position| all.draw(1, 2, position)).collect();
        for order in ORDERS {
            let count = drawn.iter().filter(|v| v.rgb == order).count();
            // 50 expected, deviation 6.5.
            assert!((20..80).contains(&count), "{order:?}: {count}");
        }
        let exposures = drawn.iter().map(|v| v.exposure);
        let (least, most) = exposures.fold((f32::MAX, 0.0), |(a, b): (f32, f32), e| {
            (a.min(e), b.max(e))
        });
        assert!((0.5..0.55).contains(&least) && (1.8..2.0).contains(&most));
    }

    #[test]
    fn every_way_to_tell_the_axes_is_drawn() {
        let axes = Augment::of(&[Kind::Axes]);
        let drawn: Vec<_> = (0..2400)
            .map(|position| axes.draw(1, 2, position))
            .map(|v| (v.axes, v.mirrored))
            .collect();
        for order in ORDERS {
            for bits in 0..8 {
                let mirrored = [0, 1, 2].map(|axis| bits >> axis & 1 != 0);
                let count = drawn.iter().filter(|v| **v == (order, mirrored)).count();
                // 50 expected, deviation 7.
                assert!((20..85).contains(&count), "{order:?} {mirrored:?}: {count}");
            }
        }
    }

    /// A patch of 32 in a scene of 36 x 34 has five rows and three columns to begin in.
    #[test]
    fn crops_are_everywhere_in_the_scene_and_in_it() {
        let patch = Patch {
            scene: 0,
            y: 4,
            x: 2,
        };
        let crop = Augment::of(&[Kind::Crop]);
        let mut counts = [[0; 3]; 5];
        for position in 0..1500 {
            let placed = crop.draw(1, 0, position).place(patch, (36, 34), 32);
            counts[placed.y as usize][placed.x as usize] += 1;
        }
        // 100 expected each, deviation 10.
        let all = counts.iter().flatten();
        assert!(all.clone().all(|n| (60..140).contains(n)), "{counts:?}");
        assert_eq!(NONE.place(patch, (36, 34), 32), patch);
    }

    /// What else is on does not change what one augmentation draws.
    #[test]
    fn augmentations_are_independent_of_each_other() {
        let all = Augment::of(&KINDS);
        for position in 0..50 {
            let (both, turns) = (all.draw(7, 0, position), TURNS.draw(7, 0, position));
            assert_eq!(turned(both), turned(turns));
        }
    }

    #[test]
    fn settings_read_as_written_and_name_what_is_allowed() {
        #[derive(Debug, PartialEq, Serialize, Deserialize)]
        struct Table {
            augment: Augment,
        }
        let only = |kinds: &[Kind]| Augment::of(kinds);
        for (text, expected) in [
            ("augment = true", only(&KINDS)),
            ("augment = false", Augment::default()),
            ("augment = [\"flip\"]", only(&[Kind::Flip])),
            ("augment = [\"transpose\", \"flip\"]", TURNS),
            ("augment = [\"rgb\"]", only(&[Kind::Rgb])),
            (
                "augment = [\"exposure\", \"rgb\"]",
                only(&[Kind::Rgb, Kind::Exposure]),
            ),
            (
                "augment = [\"noise\", \"crop\"]",
                only(&[Kind::Crop, Kind::Noise]),
            ),
            ("augment = []", Augment::default()),
        ] {
            let table: Table = toml::from_str(text).expect(text);
            assert_eq!(table.augment, expected, "{text}");
            let written = toml::to_string(&table).expect("plain data");
            assert_eq!(toml::from_str::<Table>(&written).expect("its own"), table);
        }
        let error = toml::from_str::<Table>("augment = [\"rotate\"]").expect_err("unknown");
        assert!(
            error.message().contains(
                "a list of \"flip\", \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\" and \"noise\""
            ),
            "{error}"
        );
    }
}
