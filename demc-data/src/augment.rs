//! Flips and transposes of training patches, drawn for each patch of each epoch; off in the paper's preset
//! (Sec. 4.2 names none). Normals and positions are world-space values of a pixel: they move with it and
//! keep their numbers.

use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::seed::{Use, generator};

/// Which augmentations are drawn. In a configuration: `true` (all), `false`, or a list of `"flip"` and
/// `"transpose"`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Setting", into = "Setting")]
pub struct Augment {
    /// Mirror left and right, and independently top and bottom, each half of the time.
    pub flip: bool,
    /// Swap rows and columns half of the time.
    pub transpose: bool,
}

#[derive(Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "augment must be true, false or a list of \"flip\" and \"transpose\""
)]
enum Setting {
    All(bool),
    Some(Vec<Kind>),
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Flip,
    Transpose,
}

impl From<Setting> for Augment {
    fn from(setting: Setting) -> Self {
        match setting {
            Setting::All(all) => Self {
                flip: all,
                transpose: all,
            },
            Setting::Some(kinds) => Self {
                flip: kinds.iter().any(|kind| matches!(kind, Kind::Flip)),
                transpose: kinds.iter().any(|kind| matches!(kind, Kind::Transpose)),
            },
        }
    }
}

impl From<Augment> for Setting {
    fn from(augment: Augment) -> Self {
        match (augment.flip, augment.transpose) {
            (false, false) => Setting::All(false),
            (true, true) => Setting::All(true),
            (true, false) => Setting::Some(vec![Kind::Flip]),
            (false, true) => Setting::Some(vec![Kind::Transpose]),
        }
    }
}

/// What was drawn for one patch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Orientation {
    flip_x: bool,
    flip_y: bool,
    transpose: bool,
}

impl Augment {
    /// The orientation of the patch at `position` of `epoch`.
    pub fn draw(self, seed: u64, epoch: u64, position: u64) -> Orientation {
        let bits = generator(Use::Augment, seed, epoch, position).next_u32();
        Orientation {
            flip_x: self.flip && bits & 1 != 0,
            flip_y: self.flip && bits & 2 != 0,
            transpose: self.transpose && bits & 4 != 0,
        }
    }
}

impl Orientation {
    /// Turns square planes in place.
    ///
    /// # Shapes
    /// `planes` is `[N, size, size]`.
    pub fn apply(self, planes: &mut [f32], size: usize) {
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

    const NONE: Orientation = Orientation {
        flip_x: false,
        flip_y: false,
        transpose: false,
    };

    fn turned(orientation: Orientation) -> Vec<f32> {
        let mut planes = vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
        orientation.apply(&mut planes, 3);
        planes
    }

    #[test]
    fn each_part_moves_pixels_as_its_name_says() {
        assert_eq!(turned(NONE), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
        assert_eq!(
            turned(Orientation {
                flip_x: true,
                ..NONE
            }),
            [3.0, 2.0, 1.0, 6.0, 5.0, 4.0, 9.0, 8.0, 7.0]
        );
        assert_eq!(
            turned(Orientation {
                flip_y: true,
                ..NONE
            }),
            [7.0, 8.0, 9.0, 4.0, 5.0, 6.0, 1.0, 2.0, 3.0]
        );
        assert_eq!(
            turned(Orientation {
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
        let mut images: Vec<Vec<f32>> = drawn(Augment {
            flip: true,
            transpose: true,
        })
        .map(turned)
        .collect();
        images.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        images.dedup();
        assert_eq!(images.len(), 8);
        assert!(
            drawn(Augment {
                flip: false,
                transpose: true
            })
            .all(|o| !o.flip_x && !o.flip_y)
        );
    }

    #[test]
    fn settings_read_as_written_and_name_what_is_allowed() {
        #[derive(Debug, PartialEq, Serialize, Deserialize)]
        struct Table {
            augment: Augment,
        }
        for (text, flip, transpose) in [
            ("augment = true", true, true),
            ("augment = false", false, false),
            ("augment = [\"flip\"]", true, false),
            ("augment = [\"transpose\", \"flip\"]", true, true),
            ("augment = []", false, false),
        ] {
            let table: Table = toml::from_str(text).expect(text);
            assert_eq!(table.augment, Augment { flip, transpose }, "{text}");
            let written = toml::to_string(&table).expect("plain data");
            assert_eq!(toml::from_str::<Table>(&written).expect("its own"), table);
        }
        let error = toml::from_str::<Table>("augment = [\"rotate\"]").expect_err("unknown");
        assert!(
            error
                .message()
                .contains("a list of \"flip\" and \"transpose\""),
            "{error}"
        );
    }
}
