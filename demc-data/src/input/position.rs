//! Positions relative to the image: centred at their median and divided by their extent. They then
//! do not depend on the scene's origin and unit.

use serde::{Deserialize, Serialize};

use crate::image::frame::{FEATURES, POSITIONS, TEXTURES};

use crate::image::plane::{Plane, median};

/// Largest absolute value after the mapping, in extents: farther surfaces are at this distance.
const FARTHEST: f32 = 5.0;

/// What the origin and the unit of positions are, for training and denoising.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PositionSpace {
    /// Those of the scene, as in the paper.
    #[default]
    Scene,
    /// Those of the image ([`PositionMap`]).
    Image,
}

impl PositionSpace {
    /// Whether this is the default.
    pub fn is_scene(&self) -> bool {
        *self == Self::Scene
    }
}

/// The mapping of an image's positions: `clamp((p - center) / extent, -5, 5)`. A pixel without a
/// hit (normal and position are 0) becomes 0, and so does a constant buffer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionMap {
    /// Median of each coordinate over the pixels with a hit.
    pub center: [f32; 3],
    /// Median distance from the centre; if that is 0, the mean distance.
    pub extent: f32,
}

impl PositionMap {
    /// The mapping of an image.
    ///
    /// # Shapes
    /// `features`, as rendered, is `[12, N]`.
    pub fn of(features: &[f32]) -> Self {
        let pixels = features.len() / FEATURES;
        let position = |i: usize| [0, 1, 2].map(|axis| features[(POSITIONS + axis) * pixels + i]);
        let hits: Vec<[f32; 3]> = (0..pixels)
            .filter(|i| is_hit(features, pixels, *i))
            .map(position)
            .collect();
        let center = [0, 1, 2].map(|axis| median(hits.iter().map(|hit| hit[axis])).unwrap_or(0.0));
        let distances: Vec<f32> = hits.iter().map(|hit| distance(*hit, center)).collect();
        let extent = match median(distances.iter().copied()) {
            None | Some(0.0) => distances.iter().sum::<f32>() / distances.len().max(1) as f32,
            Some(median) => median,
        };
        Self { center, extent }
    }

    /// Maps the positions of an image, or of a part of it, in place.
    ///
    /// # Shapes
    /// `features`, as rendered, is `[12, N]`.
    pub fn apply(&self, features: &mut [f32]) {
        let pixels = features.len() / FEATURES;
        for i in 0..pixels {
            let hit = self.extent > 0.0 && is_hit(features, pixels, i);
            for (axis, center) in self.center.into_iter().enumerate() {
                let value = &mut features[(POSITIONS + axis) * pixels + i];
                *value = if hit {
                    ((*value - center) / self.extent).clamp(-FARTHEST, FARTHEST)
                } else {
                    0.0
                };
            }
        }
    }
}

/// Converts the positions of 12 feature planes to `space`.
pub(crate) fn map_planes(features: &mut [Plane], space: PositionSpace) {
    if space.is_scene() {
        return;
    }
    let mut planar: Vec<f32> = features.iter().flat_map(Plane::to_f32).collect();
    PositionMap::of(&planar).apply(&mut planar);
    let pixels = planar.len() / FEATURES;
    let mapped = planar.chunks_exact(pixels.max(1)).skip(POSITIONS);
    for (plane, mapped) in features[POSITIONS..TEXTURES].iter_mut().zip(mapped) {
        *plane = Plane::Float(mapped.to_vec());
    }
}

/// Whether a ray of pixel `i` of `[12, pixels]` hit a surface: normal or position is not 0.
fn is_hit(features: &[f32], pixels: usize, i: usize) -> bool {
    (0..TEXTURES).any(|plane| features[plane * pixels + i] != 0.0)
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let squares = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b));
    squares.sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PIXELS: usize = 5;

    /// Positions on a line and one miss.
    fn features(map: impl Fn(f32) -> f32) -> Vec<f32> {
        let mut features = vec![0.0; FEATURES * PIXELS];
        for (i, x) in [-2.0, -1.0, 1.0, 2.0].into_iter().enumerate() {
            features[i] = 1.0;
            features[POSITIONS * PIXELS + i] = map(x);
            features[(POSITIONS + 1) * PIXELS + i] = map(0.0);
            features[(POSITIONS + 2) * PIXELS + i] = map(0.0);
        }
        features
    }

    fn x(mut features: Vec<f32>) -> Vec<f32> {
        PositionMap::of(&features).apply(&mut features);
        features[POSITIONS * PIXELS..(POSITIONS + 1) * PIXELS].to_vec()
    }

    #[test]
    fn origin_and_unit_of_the_scene_do_not_matter() {
        let expected = x(features(|x| x));
        // The median is 1, and the median distance from it is 2.
        assert_eq!(expected, [-1.5, -1.0, 0.0, 0.5, 0.0]);
        assert_eq!(x(features(|x| x + 1048576.0)), expected);
        assert_eq!(x(features(|x| 1024.0 * x)), expected);
    }

    #[test]
    fn far_surfaces_are_at_the_limit() {
        let mut far = features(|x| x);
        far[POSITIONS * PIXELS] = 1e9;
        assert_eq!(x(far)[0], FARTHEST);
    }

    #[test]
    fn an_absent_buffer_stays_zero_and_a_constant_one_becomes_zero() {
        assert_eq!(x(features(|_| 0.0)), [0.0; PIXELS]);
        assert_eq!(x(features(|_| 7.0)), [0.0; PIXELS]);
        assert_eq!(x(vec![0.0; FEATURES * PIXELS]), [0.0; PIXELS]);
    }

    #[test]
    fn when_most_surfaces_are_at_one_point_the_mean_distance_counts() {
        let mut features = features(|_| 3.0);
        features[POSITIONS * PIXELS] = 7.0;
        assert_eq!(x(features), [4.0, 0.0, 0.0, 0.0, 0.0]);
    }
}
