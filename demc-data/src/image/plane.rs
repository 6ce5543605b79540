//! One channel of an image in the precision of its file. Half planes stay half in the scene cache,
//! which saves half the memory.

use std::ops::Range;

use half::f16;
use half::slice::HalfFloatSliceExt;

/// Largest distance of a neighbour that repairs a sample, in pixels.
const MAX_RADIUS: usize = 8;

/// The samples of one channel, row by row, `[H, W]`.
#[derive(Debug, Clone, PartialEq)]
pub enum Plane {
    /// 16-bit floating point.
    Half(Vec<f16>),
    /// 32-bit floating point.
    Float(Vec<f32>),
    /// 32-bit unsigned integers.
    Uint(Vec<u32>),
}

/// The NaN and infinite samples of a plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NonFiniteSamples {
    /// Index of the first one.
    pub index: usize,
    /// Its value.
    pub value: f32,
    /// Number of all.
    pub count: usize,
}

impl Plane {
    /// A half plane of `samples` zeros, for a buffer that a layout declares as zeros.
    pub fn zeros(samples: usize) -> Self {
        Plane::Half(vec![f16::ZERO; samples])
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        match self {
            Plane::Half(samples) => samples.len(),
            Plane::Float(samples) => samples.len(),
            Plane::Uint(samples) => samples.len(),
        }
    }

    /// Whether there are no samples.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Memory of the samples in bytes.
    pub fn bytes(&self) -> usize {
        self.len() * if matches!(self, Plane::Half(_)) { 2 } else { 4 }
    }

    /// Copies samples from `start` on to `out` as `f32`, until `out` is full.
    ///
    /// # Panics
    /// If the plane ends before `out` is full.
    pub fn copy_to(&self, start: usize, out: &mut [f32]) {
        let end = start + out.len();
        match self {
            Plane::Half(samples) => samples[start..end].convert_to_f32_slice(out),
            Plane::Float(samples) => out.copy_from_slice(&samples[start..end]),
            Plane::Uint(samples) => {
                for (out, &sample) in out.iter_mut().zip(&samples[start..end]) {
                    *out = sample as f32;
                }
            }
        }
    }

    /// Appends the samples of a range in their own type and the machine's byte order.
    pub(crate) fn append_bytes(&self, range: Range<usize>, out: &mut Vec<u8>) {
        match self {
            Plane::Half(samples) => {
                let bits = samples[range].iter().map(|sample| sample.to_bits());
                out.extend(bits.flat_map(u16::to_ne_bytes));
            }
            Plane::Float(samples) => {
                out.extend(samples[range].iter().flat_map(|s| s.to_ne_bytes()));
            }
            Plane::Uint(samples) => {
                out.extend(samples[range].iter().flat_map(|s| s.to_ne_bytes()));
            }
        }
    }

    /// All samples as `f32`.
    pub fn to_f32(&self) -> Vec<f32> {
        let mut out = vec![0.0; self.len()];
        self.copy_to(0, &mut out);
        out
    }

    /// The value of all samples, if they are equal; `None` for an empty plane.
    pub fn constant(&self) -> Option<f32> {
        match self {
            Plane::Half(samples) => all_equal(samples).map(f16::to_f32),
            Plane::Float(samples) => all_equal(samples),
            Plane::Uint(samples) => all_equal(samples).map(|sample| sample as f32),
        }
    }

    /// The largest sample; minus infinity for an empty plane.
    pub fn max(&self) -> f32 {
        self.fold(f32::NEG_INFINITY, f32::max)
    }

    /// The smallest sample; infinity for an empty plane.
    pub fn min(&self) -> f32 {
        self.fold(f32::INFINITY, f32::min)
    }

    fn fold(&self, first: f32, choose: impl Fn(f32, f32) -> f32) -> f32 {
        match self {
            Plane::Half(samples) => samples.iter().map(|x| x.to_f32()).fold(first, choose),
            Plane::Float(samples) => samples.iter().copied().fold(first, choose),
            Plane::Uint(samples) => samples.iter().map(|x| *x as f32).fold(first, choose),
        }
    }

    /// The NaN and infinite samples; `None` if there are none.
    pub fn non_finite(&self) -> Option<NonFiniteSamples> {
        match self {
            Plane::Half(samples) => bad(samples, f16::is_finite, f16::to_f32),
            Plane::Float(samples) => bad(samples, f32::is_finite, f32::from),
            Plane::Uint(_) => None,
        }
    }

    /// Replaces NaN and infinite samples, and with `negative` those below 0. Returns their number.
    ///
    /// A sample becomes the median of the sound samples in 3x3 pixels around it. If there are none,
    /// the square grows up to 17x17 pixels; then the whole plane counts, and 0 is the last resort.
    ///
    /// `size` is height and width.
    pub fn repair(&mut self, (height, width): (usize, usize), negative: bool) -> usize {
        let samples = self.to_f32();
        let is_sound = |x: &f32| x.is_finite() && !(negative && *x < 0.0);
        let bad: Vec<usize> = (0..samples.len())
            .filter(|i| !is_sound(&samples[*i]))
            .collect();
        let mut of_plane = None;
        for &i in &bad {
            let (y, x) = (i / width, i % width);
            let near = (1..=MAX_RADIUS).find_map(|radius| {
                let rows = y.saturating_sub(radius)..(y + radius + 1).min(height);
                let columns = x.saturating_sub(radius)..(x + radius + 1).min(width);
                let square = rows.flat_map(|y| &samples[y * width..][columns.clone()]);
                median(square.copied().filter(is_sound))
            });
            let value = near.unwrap_or_else(|| {
                *of_plane.get_or_insert_with(|| {
                    let sound = samples.iter().copied().filter(is_sound);
                    median(sound).unwrap_or(0.0)
                })
            });
            self.set(i, value);
        }
        bad.len()
    }

    fn set(&mut self, i: usize, value: f32) {
        match self {
            Plane::Half(samples) => samples[i] = f16::from_f32(value),
            Plane::Float(samples) => samples[i] = value,
            Plane::Uint(samples) => samples[i] = value as u32,
        }
    }

    /// Sets negative samples to 0 and returns their number (-0 is not negative).
    pub fn clamp_negative(&mut self) -> usize {
        match self {
            Plane::Half(samples) => clamp(samples, f16::ZERO),
            Plane::Float(samples) => clamp(samples, 0.0),
            Plane::Uint(_) => 0,
        }
    }
}

/// Sets samples to 0 that are infinite in all planes.
pub(crate) fn clear_infinite(planes: &mut [Plane]) {
    // Most files have none.
    if planes.iter().any(|plane| plane.non_finite().is_none()) {
        return;
    }
    let samples: Vec<Vec<f32>> = planes.iter().map(Plane::to_f32).collect();
    let infinite = |i: &usize| samples.iter().all(|plane| plane[*i].is_infinite());
    for i in (0..samples[0].len()).filter(infinite) {
        planes.iter_mut().for_each(|plane| plane.set(i, 0.0));
    }
}

fn bad<T: Copy>(
    samples: &[T],
    finite: impl Fn(T) -> bool,
    value: impl Fn(T) -> f32,
) -> Option<NonFiniteSamples> {
    let count = samples.iter().filter(|sample| !finite(**sample)).count();
    if count == 0 {
        return None;
    }
    let index = samples.iter().position(|sample| !finite(*sample))?;
    Some(NonFiniteSamples {
        index,
        value: value(samples[index]),
        count,
    })
}

fn clamp<T: PartialOrd + Copy>(samples: &mut [T], zero: T) -> usize {
    let mut clamped = 0;
    for sample in samples.iter_mut().filter(|sample| **sample < zero) {
        *sample = zero;
        clamped += 1;
    }
    clamped
}

fn all_equal<T: Copy + PartialEq>(samples: &[T]) -> Option<T> {
    let first = *samples.first()?;
    samples.iter().all(|x| *x == first).then_some(first)
}

/// The upper median; `None` of nothing.
pub(crate) fn median(values: impl Iterator<Item = f32>) -> Option<f32> {
    let mut values: Vec<f32> = values.collect();
    let middle = values.len() / 2;
    if values.is_empty() {
        None
    } else {
        Some(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bad_sample_becomes_the_median_of_its_sound_neighbours() {
        let (nan, inf) = (f32::NAN, f32::INFINITY);
        let samples = [nan, 1.0, 2.0, -5.0, inf, 3.0];
        let mut radiance = Plane::Float(samples.to_vec());
        assert_eq!(radiance.repair((2, 3), true), 3);
        assert_eq!(radiance, Plane::Float(vec![1.0, 1.0, 2.0, 1.0, 2.0, 3.0]));
        let mut feature = half(&samples);
        assert_eq!(feature.repair((2, 3), false), 2);
        assert_eq!(feature, half(&[1.0, 1.0, 2.0, -5.0, 2.0, 3.0]));
    }

    #[test]
    fn far_neighbours_count_if_there_are_no_near_ones() {
        let mut line = Plane::Float([vec![f32::NAN; 9], vec![7.0]].concat());
        assert_eq!(line.repair((1, 10), true), 9);
        assert_eq!(line, Plane::Float(vec![7.0; 10]));
        let mut none = Plane::Float(vec![f32::NAN; 4]);
        assert_eq!(none.repair((2, 2), true), 4);
        assert_eq!(none, Plane::Float(vec![0.0; 4]));
    }

    fn half(samples: &[f32]) -> Plane {
        Plane::Half(samples.iter().map(|&s| f16::from_f32(s)).collect())
    }

    #[test]
    fn a_part_of_every_precision_reads_as_the_same_numbers() {
        for plane in [
            half(&[0.0, 1.0, 2.0, 3.0]),
            Plane::Float(vec![0.0, 1.0, 2.0, 3.0]),
            Plane::Uint(vec![0, 1, 2, 3]),
        ] {
            let mut out = [0.0; 2];
            plane.copy_to(1, &mut out);
            assert_eq!(out, [1.0, 2.0]);
            assert_eq!(plane.to_f32(), [0.0, 1.0, 2.0, 3.0]);
        }
    }

    #[test]
    fn half_planes_take_half_the_memory() {
        assert_eq!(half(&[1.0; 6]).bytes(), 12);
        assert_eq!(Plane::Float(vec![1.0; 6]).bytes(), 24);
    }

    #[test]
    fn the_first_bad_sample_is_named_and_all_are_counted() {
        let bad = NonFiniteSamples {
            index: 1,
            value: f32::INFINITY,
            count: 2,
        };
        let plane = half(&[0.0, f32::INFINITY, 2.0, f32::NAN]);
        assert_eq!(plane.non_finite(), Some(bad));
        assert!(half(&[1.0]).non_finite().is_none());
    }

    #[test]
    fn only_negative_samples_are_clamped() {
        let mut plane = Plane::Float(vec![-1.0, -0.0, 0.0, 2.0, -3.0]);
        assert_eq!(plane.clamp_negative(), 2);
        assert_eq!(plane.to_f32(), [0.0, 0.0, 0.0, 2.0, 0.0]);
        assert_eq!(half(&[-1.0, 1.0]).clamp_negative(), 1);
    }
}
