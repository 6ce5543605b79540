//! Views of images in memory.

use half::f16;
use rayon::prelude::*;

use super::error::{BufferError, Shape};

/// Type of samples, in the machine's byte order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sample {
    /// 16-bit floating point.
    Half,
    /// 32-bit floating point.
    Float,
}

impl Sample {
    /// Size of a sample in bytes.
    pub fn bytes(self) -> usize {
        match self {
            Sample::Half => 2,
            Sample::Float => 4,
        }
    }
}

/// The bytes of an image, counted from its first sample: the first one and the end. `shape` has channels,
/// height, and width; `strides` are the bytes from one to the next. An image without samples has none.
pub fn extent(sample: Sample, shape: [usize; 3], strides: [isize; 3]) -> (i128, i128) {
    if shape.contains(&0) {
        return (0, 0);
    }
    let (mut low, mut high) = (0, sample.bytes() as i128);
    for (count, stride) in shape.into_iter().zip(strides) {
        let far = (count as i128 - 1) * stride as i128;
        low += far.min(0);
        high += far.max(0);
    }
    (low, high)
}

/// Where the samples of an image lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Placement {
    sample: Sample,
    /// Channels, height, and width.
    shape: [usize; 3],
    /// Byte of the first sample.
    first: usize,
    /// Bytes from a channel, row, and column to the next one.
    strides: [isize; 3],
}

impl Placement {
    /// Checks that all samples are within `bytes`.
    fn within(self, bytes: usize) -> Result<Self, BufferError> {
        let Self { shape, first, .. } = self;
        if shape.contains(&0) {
            return Ok(self);
        }
        let (low, high) = extent(self.sample, shape, self.strides);
        let first = first as i128;
        if first + low >= 0 && first + high <= bytes as i128 {
            Ok(self)
        } else {
            Err(BufferError::Outside {
                shape: Shape(shape),
                bytes,
            })
        }
    }

    /// Checks that no two samples share memory: each stride passes over all samples of the smaller
    /// ones.
    fn disjoint(self) -> Result<Self, BufferError> {
        let mut axes: Vec<(usize, usize)> = self
            .shape
            .iter()
            .zip(self.strides)
            .filter(|(count, _)| **count > 1)
            .map(|(count, stride)| (stride.unsigned_abs(), *count))
            .collect();
        axes.sort_unstable();
        let mut extent = self.sample.bytes();
        for (stride, count) in axes {
            if stride < extent {
                return Err(BufferError::Overlap {
                    shape: Shape(self.shape),
                    strides: self.strides,
                });
            }
            extent += stride * (count - 1);
        }
        Ok(self)
    }

    fn planar(sample: Sample, [channels, height, width]: [usize; 3]) -> Self {
        let row = (width * sample.bytes()) as isize;
        Self {
            sample,
            shape: [channels, height, width],
            first: 0,
            strides: [row * height as isize, row, sample.bytes() as isize],
        }
    }

    fn interleaved(sample: Sample, [channels, height, width]: [usize; 3]) -> Self {
        let pixel = (channels * sample.bytes()) as isize;
        Self {
            sample,
            shape: [channels, height, width],
            first: 0,
            strides: [sample.bytes() as isize, pixel * width as isize, pixel],
        }
    }

    /// Byte of the first sample of a row of a channel.
    fn row(&self, channel: usize, row: usize) -> usize {
        let [per_channel, per_row, _] = self.strides;
        let offset = channel as isize * per_channel + row as isize * per_row;
        self.first.wrapping_add_signed(offset)
    }

    fn samples(&self) -> usize {
        self.shape.iter().product()
    }
}

/// An image of half or float samples, channels by rows by columns, with any strides.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    bytes: &'a [u8],
    placement: Placement,
}

impl<'a> View<'a> {
    /// The image of `shape` (channels, height, width) in `bytes`. Its first sample is at byte
    /// `first`; `strides` are the bytes, of either sign or 0, from a channel, row, and column to the
    /// next one.
    ///
    /// # Errors
    /// Samples outside `bytes`.
    pub fn new(
        bytes: &'a [u8],
        sample: Sample,
        shape: [usize; 3],
        first: usize,
        strides: [isize; 3],
    ) -> Result<Self, BufferError> {
        let placement = Placement {
            sample,
            shape,
            first,
            strides,
        }
        .within(bytes.len())?;
        Ok(Self { bytes, placement })
    }

    /// An image whose planes, and whose rows, lie one after another.
    ///
    /// # Errors
    /// Too few bytes.
    pub fn planar(bytes: &'a [u8], sample: Sample, shape: [usize; 3]) -> Result<Self, BufferError> {
        let placement = Placement::planar(sample, shape).within(bytes.len())?;
        Ok(Self { bytes, placement })
    }

    /// An image whose pixels, each with all channels, lie one after another.
    ///
    /// # Errors
    /// Too few bytes.
    pub fn interleaved(
        bytes: &'a [u8],
        sample: Sample,
        shape: [usize; 3],
    ) -> Result<Self, BufferError> {
        let placement = Placement::interleaved(sample, shape).within(bytes.len())?;
        Ok(Self { bytes, placement })
    }

    /// Number of channels, height, and width.
    pub fn shape(&self) -> [usize; 3] {
        self.placement.shape
    }

    /// The samples, planar.
    ///
    /// # Errors
    /// Not enough memory.
    pub fn to_planar(&self) -> Result<Vec<f32>, BufferError> {
        let placement = &self.placement;
        let [_, height, width] = placement.shape;
        let count = placement.samples();
        let mut planar: Vec<f32> = Vec::new();
        let reserved = planar.try_reserve_exact(count);
        reserved.map_err(|_| BufferError::Memory {
            mib: (count * size_of::<f32>()).div_ceil(1 << 20),
        })?;
        planar.resize(count, 0.0);
        let rows = planar.par_chunks_mut(width.max(1)).enumerate();
        rows.for_each(|(index, row)| {
            let mut start = placement.row(index / height, index % height);
            for value in row {
                *value = match placement.sample {
                    Sample::Half => f16::from_ne_bytes(self.sample(start)).to_f32(),
                    Sample::Float => f32::from_ne_bytes(self.sample(start)),
                };
                start = start.wrapping_add_signed(placement.strides[2]);
            }
        });
        Ok(planar)
    }

    /// Height and width in pixels.
    pub fn size(&self) -> (usize, usize) {
        let [_, height, width] = self.placement.shape;
        (height, width)
    }

    fn sample<const N: usize>(&self, start: usize) -> [u8; N] {
        std::array::from_fn(|byte| self.bytes[start + byte])
    }
}

/// As [`View`], for an output. No two samples share memory.
#[derive(Debug)]
pub struct ViewMut<'a> {
    bytes: &'a mut [u8],
    placement: Placement,
}

impl<'a> ViewMut<'a> {
    /// As [`View::new`].
    ///
    /// # Errors
    /// Samples outside `bytes`, or two at one place.
    pub fn new(
        bytes: &'a mut [u8],
        sample: Sample,
        shape: [usize; 3],
        first: usize,
        strides: [isize; 3],
    ) -> Result<Self, BufferError> {
        let placement = Placement {
            sample,
            shape,
            first,
            strides,
        }
        .within(bytes.len())?
        .disjoint()?;
        Ok(Self { bytes, placement })
    }

    /// As [`View::planar`].
    ///
    /// # Errors
    /// Too few bytes.
    pub fn planar(
        bytes: &'a mut [u8],
        sample: Sample,
        shape: [usize; 3],
    ) -> Result<Self, BufferError> {
        let placement = Placement::planar(sample, shape).within(bytes.len())?;
        Ok(Self { bytes, placement })
    }

    /// As [`View::interleaved`].
    ///
    /// # Errors
    /// Too few bytes.
    pub fn interleaved(
        bytes: &'a mut [u8],
        sample: Sample,
        shape: [usize; 3],
    ) -> Result<Self, BufferError> {
        let placement = Placement::interleaved(sample, shape).within(bytes.len())?;
        Ok(Self { bytes, placement })
    }

    /// Number of channels, height, and width.
    pub fn shape(&self) -> [usize; 3] {
        self.placement.shape
    }

    /// Writes planar samples. Half samples are limited to 65504, the largest half. Returns the number
    /// of samples that were limited.
    ///
    /// # Errors
    /// Another number of samples.
    pub fn write(&mut self, planar: &[f32]) -> Result<usize, BufferError> {
        let placement = self.placement;
        let [_, height, width] = placement.shape;
        if planar.len() != placement.samples() {
            return Err(BufferError::Output {
                found: placement.samples(),
                expected: planar.len(),
            });
        }
        let mut limited = 0;
        for (index, row) in planar.chunks(width.max(1)).enumerate() {
            let mut start = placement.row(index / height, index % height);
            for value in row {
                match placement.sample {
                    Sample::Float => self.store(start, value.to_ne_bytes()),
                    Sample::Half => {
                        let limit = f16::MAX.to_f32();
                        limited += usize::from(value.abs() > limit);
                        let half = f16::from_f32(value.clamp(-limit, limit));
                        self.store(start, half.to_ne_bytes());
                    }
                }
                start = start.wrapping_add_signed(placement.strides[2]);
            }
        }
        Ok(limited)
    }

    fn store<const N: usize>(&mut self, start: usize, sample: [u8; N]) {
        self.bytes[start..start + N].copy_from_slice(&sample);
    }
}
