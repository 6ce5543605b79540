//! Marks of swapped, packed and turned buffers, from what normals, positions and textures are: unit vectors in the space of
//! the positions, points of surfaces that those normals stand on, reflectances.
//!
//! Medians over a regular share of the pixels whose camera rays all hit something. The limits leave room for every one of the
//! data set's 108 scenes; the farthest of them is named beside each.

use demc_data::Frame;

use super::Warning;

/// Most pixels that are looked at.
const SAMPLES: usize = 1 << 16;
/// Fewest pixels that tell anything.
const FEWEST: usize = 64;
/// How long a normal is, in the median (all scenes: 1.00).
const UNIT: std::ops::RangeInclusive<f32> = 0.9..=1.1;
/// Share of the pixels where a packed normal, unpacked, is a unit vector (of all scenes' normals at least 0.755 are, in the classroom;
/// of their textures, taken for packed normals, at most 0.589).
const PACKED: f32 = 0.67;
/// How far below 0 a packed normal or a texture may lie.
const BELOW: f32 = -0.05;
/// Least cosine between the normals and those of the surface that the positions make, in the median (classroom: 0.977).
const ALIGNED: f32 = 0.8;
/// Share of the normals that are turned towards the origin from which on the origin must be the camera (staircase: 0.995).
const FACING: f32 = 0.9995;

/// Planes of the features.
const NORMAL: usize = 0;
const POSITION: usize = 3;
const TEXTURE1: usize = 6;

type Vector = [f32; 3];

/// Everything that is found.
pub(super) fn warnings(frame: &Frame) -> Vec<Warning> {
    let hits = Hits::of(frame);
    if hits.pixels.len() < FEWEST {
        return Vec::new();
    }
    [hits.normals(), hits.texture()]
        .into_iter()
        .flatten()
        .collect()
}

/// A frame, and pixels within it that hit a surface, as all their neighbours do.
struct Hits<'a> {
    frame: &'a Frame,
    pixels: Vec<usize>,
}

impl<'a> Hits<'a> {
    fn of(frame: &'a Frame) -> Self {
        let Frame { width, height, .. } = *frame;
        let vector = |i| at(frame, POSITION, i);
        let hit = |i: usize| match &frame.mask {
            Some(mask) => mask[i] >= 1.0,
            None => vector(i) != [0.0; 3],
        };
        let inner = |length: usize| 1..length.saturating_sub(1);
        let count = inner(width).len() * inner(height).len();
        let pixels = inner(height)
            .flat_map(|y| inner(width).map(move |x| y * width + x))
            .step_by(count.div_ceil(SAMPLES).max(1))
            .filter(|i| {
                [*i, i - 1, i + 1, i - width, i + width]
                    .into_iter()
                    .all(hit)
            })
            .collect();
        Self { frame, pixels }
    }

    /// What is wrong with the normals; the first of the marks that fits.
    fn normals(&self) -> Option<Warning> {
        let length = self.median(|i| norm(at(self.frame, NORMAL, i)));
        let packed = |i| at(self.frame, NORMAL, i).map(|x| 2.0 * x - 1.0);
        let warning = |found, cause| {
            Some(Warning {
                what: "normal".into(),
                found,
                cause,
            })
        };
        let unpacked = self.share(|i| UNIT.contains(&norm(packed(i))));
        if unpacked >= PACKED && self.least(NORMAL) >= BELOW {
            let percent = 100.0 * unpacked;
            return warning(
                format!(
                    "no value is negative, and 2 n - 1 is a unit vector at {percent:.0} % of the pixels"
                ),
                "packed into 0 to 1? Unpack it: n = 2 x - 1",
            );
        }
        if !UNIT.contains(&length) {
            return warning(
                format!("its length is {length:.2} in the median, not 1"),
                "another buffer (swapped with a texture?) or not normalised",
            );
        }
        let cosine = self.median(|i| self.cosine(i));
        if cosine < ALIGNED {
            return warning(
                format!(
                    "it stands on the surface that the positions make at a cosine of {cosine:.2}"
                ),
                "normals in camera space beside positions in world space, or axes swapped?",
            );
        }
        let facing =
            self.share(|i| dot(at(self.frame, NORMAL, i), at(self.frame, POSITION, i)) < 0.0);
        if facing > FACING {
            return warning(
                "all normals are turned towards the origin".into(),
                "normals and positions in camera space? The network was trained on world space",
            );
        }
        None
    }

    fn texture(&self) -> Option<Warning> {
        let least = self.least(TEXTURE1);
        (least < BELOW).then(|| Warning {
            what: "texture1".into(),
            found: format!("it goes down to {least:.2}"),
            cause: "a reflectance is not negative: swapped with the normal?",
        })
    }

    /// Cosine between the normal and that of the surface through the neighbours' positions, without regard to its side.
    fn cosine(&self, i: usize) -> f32 {
        let position = |i| at(self.frame, POSITION, i);
        let across = difference(position(i + 1), position(i - 1));
        let down = difference(
            position(i + self.frame.width),
            position(i - self.frame.width),
        );
        let surface = cross(across, down);
        let normal = at(self.frame, NORMAL, i);
        // Where the positions do not move (a flat buffer), nothing is known.
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

    /// The least value of a buffer.
    fn least(&self, first: usize) -> f32 {
        let vectors = self.pixels.iter().map(|i| at(self.frame, first, *i));
        vectors.flatten().fold(f32::INFINITY, f32::min)
    }
}

/// Three planes from `first` on, at pixel `i`.
fn at(frame: &Frame, first: usize, i: usize) -> Vector {
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
mod tests {
    use super::*;
    use demc_data::FEATURES;

    const SIDE: usize = 40;

    /// A floor and a wall seen from `camera`, in world space, with a grey texture.
    fn room(camera: Vector) -> Frame {
        let pixels = SIDE * SIDE;
        let mut features = vec![0.5; FEATURES * pixels];
        for y in 0..SIDE {
            for x in 0..SIDE {
                let at = [x, y].map(|v| v as f32 / SIDE as f32 - 0.49);
                // Through the pixel, down to the floor y = 0 or to the wall z = 0, whatever is nearer.
                let ray = [at[0], -at[1], -1.0];
                let wall = camera[2];
                let floor = if ray[1] < 0.0 {
                    -camera[1] / ray[1]
                } else {
                    f32::INFINITY
                };
                let (distance, normal) = match floor < wall {
                    true => (floor, [0.0, 1.0, 0.0]),
                    false => (wall, [0.0, 0.0, 1.0]),
                };
                for channel in 0..3 {
                    let i = y * SIDE + x;
                    features[(NORMAL + channel) * pixels + i] = normal[channel];
                    features[(POSITION + channel) * pixels + i] =
                        camera[channel] + distance * ray[channel];
                }
            }
        }
        Frame {
            name: "room".into(),
            width: SIDE,
            height: SIDE,
            color: vec![0.5; 3 * pixels],
            features,
            reference: None,
            mask: Some(vec![1.0; pixels]),
            clamped: 0,
        }
    }

    /// Each vector of a buffer by `map`.
    fn mapped(mut frame: Frame, first: usize, map: impl Fn(Vector) -> Vector) -> Frame {
        let pixels = SIDE * SIDE;
        for i in 0..pixels {
            let vector = map(at(&frame, first, i));
            for (channel, value) in vector.into_iter().enumerate() {
                frame.features[(first + channel) * pixels + i] = value;
            }
        }
        frame
    }

    fn found(frame: &Frame) -> Vec<String> {
        let found = warnings(frame).into_iter();
        found.map(|warning| warning.to_string()).collect()
    }

    const CAMERA: Vector = [1.0, 1.5, 4.0];

    #[test]
    fn a_room_in_world_space_is_quiet() {
        assert_eq!(found(&room(CAMERA)), [""; 0]);
    }

    #[test]
    fn each_mistake_has_its_own_words() {
        let one = |frame: &Frame| match &found(frame)[..] {
            [warning] => warning.clone(),
            others => panic!("one warning, not {others:?}"),
        };
        let packed = mapped(room(CAMERA), NORMAL, |n| n.map(|x| x / 2.0 + 0.5));
        assert!(one(&packed).contains("packed into 0 to 1"));
        let long = mapped(room(CAMERA), NORMAL, |n| n.map(|x| 2.0 * x));
        assert!(one(&long).starts_with("normal: its length is 2.00"));
        let turned = mapped(room(CAMERA), NORMAL, |[x, y, z]| [x, z, -y]);
        assert!(one(&turned).contains("camera space beside positions in world space"));
        let camera = mapped(room(CAMERA), POSITION, |p| difference(p, CAMERA));
        assert!(one(&camera).contains("normals and positions in camera space"));
        let shifted = mapped(room(CAMERA), TEXTURE1, |t| t.map(|x| x - 1.0));
        assert!(one(&shifted).starts_with("texture1: it goes down to -0.50"));
    }

    #[test]
    fn swapped_buffers_are_named_both() {
        let mut frame = mapped(room(CAMERA), NORMAL, |[x, y, z]| [x, -y, z]);
        let pixels = SIDE * SIDE;
        for i in 0..3 * pixels {
            frame
                .features
                .swap(NORMAL * pixels + i, TEXTURE1 * pixels + i);
        }
        let found = found(&frame);
        assert!(
            found[0].starts_with("normal: its length is 0.87"),
            "{found:?}"
        );
        assert!(
            found[1].starts_with("texture1: it goes down to -1.00"),
            "{found:?}"
        );
    }

    #[test]
    fn an_image_that_hits_nothing_or_is_tiny_says_nothing() {
        let mut frame = mapped(room(CAMERA), NORMAL, |n| n.map(|x| 2.0 * x));
        frame.mask = Some(vec![0.0; SIDE * SIDE]);
        assert_eq!(found(&frame), [""; 0]);
        assert_eq!(found(&crate::bundle::testing::frame(1, 1)), [""; 0]);
        assert_eq!(found(&crate::bundle::testing::frame(2, 40)), [""; 0]);
    }
}
