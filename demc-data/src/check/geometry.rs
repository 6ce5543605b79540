//! Detects swapped, packed and rotated buffers from the properties of the buffers.
//!
//! - Normals are unit vectors and perpendicular to the surface that the positions describe.
//! - Normals and positions are in the same space, world space.
//! - Albedo is not negative.
//!
//! Each test takes a median or a share over a regular grid of pixels that hit a surface. All 108
//! scenes of the data set pass; the scene closest to each limit is named beside it.

use std::fmt;

use crate::image::frame::{Frame, POSITIONS};

/// Largest number of tested pixels.
const MAX_SAMPLES: usize = 1 << 16;
/// Smallest number of pixels for a meaningful test.
const MIN_SAMPLES: usize = 64;
/// Median length of the normals (all scenes: 1.00).
const UNIT: std::ops::RangeInclusive<f32> = 0.9..=1.1;
/// Share of pixels with a unit vector after unpacking that identifies packed normals. Of the
/// scenes' own normals, packed, at least 0.755 are (classroom); of their albedo at most 0.589.
const PACKED: f32 = 0.67;
/// Smallest value of a packed normal or an albedo.
const LOWEST: f32 = -0.05;
/// Smallest median cosine between the normals and the surface that the positions describe
/// (classroom: 0.977).
const ALIGNED: f32 = 0.8;
/// Cosine between a normal and that surface below which it is far from it.
const STEEP: f32 = 0.5;
/// Share of such normals above which axes may be exchanged (renders: 0.24), and the share of that which must
/// remain with the axes in another order (renders: 1).
const MOST_STEEP: f32 = 0.1;
const FEWER: f32 = 0.5;
/// Share of normals that face the origin above which the origin may be the camera (staircase:
/// 0.995).
const FACING: f32 = 0.9995;
/// Smallest distance of a position from the line through the ends of its row or column, in lengths of
/// that line. Nearer positions do not tell where the camera is.
const OFF_LINE: f32 = 0.02;
/// Largest distance of the origin from the plane through a position and those ends, in lengths of the
/// position. All rays of a row lie in one plane through the camera.
const IN_PLANE: f32 = 0.03;
/// Share of positions with the origin in that plane above which it is the camera.
const PLANAR: f32 = 0.9;

/// First plane of each buffer.
const NORMAL: usize = 0;
const TEXTURE1: usize = 6;

type Vector = [f32; 3];

/// One sign that an image differs from the training data.
#[derive(Debug, Clone, PartialEq)]
pub struct Warning {
    /// The buffer or channel.
    pub what: String,
    /// The measured values.
    pub found: String,
    /// The likely cause.
    pub cause: &'static str,
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { what, found, cause } = self;
        write!(f, "{what}: {found}; {cause}")
    }
}

/// Signs of swapped, packed and rotated buffers. The list is empty if fewer than 64 tested pixels hit
/// a surface.
///
/// # Panics
/// If a buffer of the frame does not have its size.
pub fn warnings(frame: &Frame) -> Vec<Warning> {
    let hits = SurfacePixels::of(frame);
    if hits.pixels.len() < MIN_SAMPLES {
        return Vec::new();
    }
    [hits.normals(), hits.texture()]
        .into_iter()
        .flatten()
        .collect()
}

/// A frame, and the tested pixels: they and their four neighbours hit a surface.
struct SurfacePixels<'a> {
    frame: &'a Frame,
    pixels: Vec<usize>,
}

impl<'a> SurfacePixels<'a> {
    fn of(frame: &'a Frame) -> Self {
        let Frame { width, height, .. } = *frame;
        let inner = |length: usize| 1..length.saturating_sub(1);
        let count = inner(width).len() * inner(height).len();
        let pixels = inner(height)
            .flat_map(|y| inner(width).map(move |x| y * width + x))
            .step_by(count.div_ceil(MAX_SAMPLES).max(1))
            .filter(|i| {
                [*i, i - 1, i + 1, i - width, i + width]
                    .into_iter()
                    .all(|i| hits(frame, i))
            })
            .collect();
        Self { frame, pixels }
    }

    fn normals(&self) -> Option<Warning> {
        let length = self.median(|i| norm(vector(self.frame, NORMAL, i)));
        let packed = |i| vector(self.frame, NORMAL, i).map(|x| 2.0 * x - 1.0);
        let warning = |found, cause| {
            Some(Warning {
                what: "normal".into(),
                found,
                cause,
            })
        };
        let unpacked = self.share(|i| UNIT.contains(&norm(packed(i))));
        if unpacked >= PACKED && self.minimum(NORMAL) >= LOWEST {
            let percent = 100.0 * unpacked;
            return warning(
                format!(
                    "no value is negative, and 2 n - 1 is a unit vector at {percent:.0} % of the pixels"
                ),
                "is it packed into 0 to 1? Unpack it: n = 2 x - 1",
            );
        }
        if !UNIT.contains(&length) {
            return warning(
                format!("its length is {length:.2} in the median, not 1"),
                "is it another buffer (swapped with albedo?), or not normalised?",
            );
        }
        let cosine = self.median(|i| self.cosine(i, [0, 1, 2]));
        if cosine < ALIGNED {
            return warning(
                format!(
                    "its median cosine with the surface that the positions describe is {cosine:.2}, not 1"
                ),
                "are normals in camera space and positions in world space, or axes swapped?",
            );
        }
        let steep = self.share(|i| self.cosine(i, [0, 1, 2]) < STEEP);
        if steep > MOST_STEEP {
            let others = [[1, 0, 2], [0, 2, 1], [2, 1, 0], [1, 2, 0], [2, 0, 1]];
            let shares = others.map(|axes| self.share(|i| self.cosine(i, axes) < STEEP));
            let best = shares.into_iter().fold(1.0, f32::min);
            if best < FEWER * steep {
                let [found, best] = [steep, best].map(|share| 100.0 * share);
                return warning(
                    format!(
                        "it is far from the surface that the positions describe at {found:.0} % of the pixels, with \
                         exchanged axes at {best:.0} %"
                    ),
                    "are its axes exchanged, or those of the position?",
                );
            }
        }
        let facing = self.share(|i| {
            dot(
                vector(self.frame, NORMAL, i),
                vector(self.frame, POSITIONS, i),
            ) < 0.0
        });
        if facing > FACING && self.origin_is_camera() {
            return warning(
                "all normals face the origin".into(),
                "are normals and positions in camera space? The network was trained on world space",
            );
        }
        None
    }

    /// Whether the positions of each row and column lie in a plane through the origin, as rays from it do. The
    /// answer is no if each row and column lies on a line, as on a wall, which tells nothing.
    fn origin_is_camera(&self) -> bool {
        let Frame { width, height, .. } = *self.frame;
        let ends = |mut line: Box<dyn DoubleEndedIterator<Item = usize>>| {
            let hit = |i: &usize| hits(self.frame, *i);
            let first = line.find(hit)?;
            Some([first, line.rfind(hit)?])
        };
        let row = |y: usize| ends(Box::new(y * width..(y + 1) * width));
        let column = |x: usize| ends(Box::new((x..height * width).step_by(width)));
        let rows: Vec<_> = (0..height).map(row).collect();
        let columns: Vec<_> = (0..width).map(column).collect();
        let (mut told, mut planar) = (0, 0);
        for &i in &self.pixels {
            for ends in [rows[i / width], columns[i % width]].into_iter().flatten() {
                let [a, b, x] = [ends[0], ends[1], i].map(|i| vector(self.frame, POSITIONS, i));
                let line = difference(b, a);
                let plane = cross(line, difference(x, a));
                let area = norm(plane);
                if area > OFF_LINE * dot(line, line) {
                    told += 1;
                    planar += usize::from(dot(plane, x).abs() < IN_PLANE * area * norm(x));
                }
            }
        }
        told >= MIN_SAMPLES && planar as f32 > PLANAR * told as f32
    }

    fn texture(&self) -> Option<Warning> {
        let minimum = self.minimum(TEXTURE1);
        (minimum < LOWEST).then(|| Warning {
            what: "texture1".into(),
            found: format!("its minimum is {minimum:.2}"),
            cause: "albedo is not negative: is it swapped with the normal?",
        })
    }

    /// Absolute cosine between the normal, with its axes in this order, and the surface through the
    /// neighbours' positions.
    fn cosine(&self, i: usize, axes: [usize; 3]) -> f32 {
        let position = |i| vector(self.frame, POSITIONS, i);
        let across = difference(position(i + 1), position(i - 1));
        let down = difference(
            position(i + self.frame.width),
            position(i - self.frame.width),
        );
        let surface = cross(across, down);
        let named = vector(self.frame, NORMAL, i);
        let normal = axes.map(|axis| named[axis]);
        // A constant position buffer describes no surface.
        match norm(surface) * norm(normal) {
            0.0 => 1.0,
            lengths => (dot(surface, normal) / lengths).abs(),
        }
    }

    fn median(&self, value: impl Fn(usize) -> f32) -> f32 {
        let mut values: Vec<f32> = self.pixels.iter().map(|i| value(*i)).collect();
        let middle = values.len() / 2;
        *values.select_nth_unstable_by(middle, f32::total_cmp).1
    }

    fn share(&self, holds: impl Fn(usize) -> bool) -> f32 {
        let count = self.pixels.iter().filter(|i| holds(**i)).count();
        count as f32 / self.pixels.len() as f32
    }

    fn minimum(&self, first: usize) -> f32 {
        let vectors = self.pixels.iter().map(|i| vector(self.frame, first, *i));
        vectors.flatten().fold(f32::INFINITY, f32::min)
    }
}

/// Whether all rays of a pixel hit a surface.
fn hits(frame: &Frame, i: usize) -> bool {
    match &frame.mask {
        Some(mask) => mask[i] >= 1.0,
        None => vector(frame, POSITIONS, i) != [0.0; 3],
    }
}

fn vector(frame: &Frame, first: usize, i: usize) -> Vector {
    let pixels = frame.width * frame.height;
    std::array::from_fn(|channel| frame.features[(first + channel) * pixels + i])
}

fn dot(a: Vector, b: Vector) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn norm(a: Vector) -> f32 {
    dot(a, a).sqrt()
}

fn difference(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| a[i] - b[i])
}

fn cross(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|i| {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        a[j] * b[k] - a[k] * b[j]
    })
}

#[cfg(test)]
mod tests;
