//! Positions relative to the image: centred at their median and divided by their extent. They then
//! do not depend on the scene's origin and unit.

use serde::{Deserialize, Serialize};

use crate::frame::FEATURES;
use crate::plane::Plane;

/// First plane of the positions.
const FIRST: usize = 3;
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
        let planes = Planes::of(features);
        let hits: Vec<usize> = (0..planes.pixels()).filter(|i| planes.is_hit(*i)).collect();
        let center = [0, 1, 2].map(|axis| median(hits.iter().map(|i| planes.position(*i)[axis])));
        let distances = hits.iter().map(|i| distance(planes.position(*i), center));
        let distances: Vec<f32> = distances.collect();
        let extent = match median(distances.iter().copied()) {
            0.0 => distances.iter().sum::<f32>() / distances.len().max(1) as f32,
            median => median,
        };
        Self { center, extent }
    }

    /// Maps the positions of an image, or of a part of it, in place.
    ///
    /// # Shapes
    /// `features`, as rendered, is `[12, N]`.
    pub fn apply(&self, features: &mut [f32]) {
        let pixels = features.len() / FEATURES;
        let (normals, rest) = features.split_at_mut(FIRST * pixels);
        let positions = &mut rest[..3 * pixels];
        for i in 0..pixels {
            let at = [i, i + pixels, i + 2 * pixels];
            let is_hit = at
                .iter()
                .any(|i| normals[*i] != 0.0 || positions[*i] != 0.0);
            for (i, center) in at.into_iter().zip(self.center) {
                positions[i] = match is_hit && self.extent > 0.0 {
                    true => ((positions[i] - center) / self.extent).clamp(-FARTHEST, FARTHEST),
                    false => 0.0,
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
    let mapped = planar.chunks_exact(pixels.max(1)).skip(FIRST);
    for (plane, mapped) in features[FIRST..FIRST + 3].iter_mut().zip(mapped) {
        *plane = Plane::Float(mapped.to_vec());
    }
}

/// Normals and positions of `[12, N]`.
struct Planes<'a>(&'a [f32]);

impl<'a> Planes<'a> {
    fn of(features: &'a [f32]) -> Self {
        Self(&features[..features.len() / FEATURES * (FIRST + 3)])
    }

    fn pixels(&self) -> usize {
        self.0.len() / (FIRST + 3)
    }

    fn position(&self, i: usize) -> [f32; 3] {
        [3, 4, 5].map(|plane| self.0[plane * self.pixels() + i])
    }

    fn is_hit(&self, i: usize) -> bool {
        let mut planes = self.0.chunks_exact(self.pixels());
        planes.any(|plane| plane[i] != 0.0)
    }
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let squares = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b));
    squares.sum::<f32>().sqrt()
}

/// The upper median; 0 of nothing.
fn median(values: impl Iterator<Item = f32>) -> f32 {
    let mut values: Vec<f32> = values.collect();
    match values.len() {
        0 => 0.0,
        length => *values.select_nth_unstable_by(length / 2, f32::total_cmp).1,
    }
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
            features[FIRST * PIXELS + i] = map(x);
            features[(FIRST + 1) * PIXELS + i] = map(0.0);
            features[(FIRST + 2) * PIXELS + i] = map(0.0);
        }
        features
    }

    fn x(mut features: Vec<f32>) -> Vec<f32> {
        PositionMap::of(&features).apply(&mut features);
        features[FIRST * PIXELS..(FIRST + 1) * PIXELS].to_vec()
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
        far[FIRST * PIXELS] = 1e9;
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
        features[FIRST * PIXELS] = 7.0;
        assert_eq!(x(features), [4.0, 0.0, 0.0, 0.0, 0.0]);
    }
}
