//! Images in the caller's memory: names, formats, and strides.

use std::ffi::{c_uint, c_void};
use std::slice;

use demc_data::image::exr::check_size;
use demc_infer::buffers::{BufferError, Sample, View, ViewMut, extent};

use crate::error::Failure;

/// Format of a pixel. The numbers are those of Open Image Denoise.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DemcFormat {
    /// One 32-bit float.
    Float = 1,
    /// Three 32-bit floats.
    Float3 = 3,
    /// One 16-bit float (IEEE binary16).
    Half = 257,
    /// Three 16-bit floats.
    Half3 = 259,
}

/// A `DemcFormat` from C, which may be any number.
pub type FormatCode = c_uint;

impl DemcFormat {
    const ALL: [Self; 4] = [Self::Float, Self::Float3, Self::Half, Self::Half3];

    fn channels(self) -> usize {
        match self {
            Self::Float3 | Self::Half3 => 3,
            _ => 1,
        }
    }

    fn sample(self) -> Sample {
        match self {
            Self::Half | Self::Half3 => Sample::Half,
            _ => Sample::Float,
        }
    }
}

/// Prefixes of the names of layers.
pub(crate) const LAYER: &str = "layer:";
pub(crate) const OUTPUT_LAYER: &str = "outputLayer:";

/// Names of the images with three channels and with one.
const THREE: [&str; 6] = ["color", "normal", "position", "albedo", "albedo2", "output"];
const ONE: [&str; 2] = ["alpha", "outputAlpha"];

/// Checks the name of an image.
///
/// # Errors
/// It is unknown, or a layer without a name.
pub(crate) fn check_name(name: &str) -> Result<(), Failure> {
    let layer = name
        .strip_prefix(LAYER)
        .or_else(|| name.strip_prefix(OUTPUT_LAYER));
    let is_known = layer.is_some_and(|layer| !layer.is_empty());
    if is_known || THREE.contains(&name) || ONE.contains(&name) {
        Ok(())
    } else {
        Err(Failure::argument(format!(
            "no image is called `{name}`; images are {}, {}, {LAYER}NAME, and {OUTPUT_LAYER}NAME",
            THREE.join(", "),
            ONE.join(", ")
        )))
    }
}

/// Where the pixels of an image lie, as the caller says it. Strides are in bytes; 0 is packed.
pub(crate) struct Layout {
    pub size: [usize; 2],
    pub offset: usize,
    /// `None`: the channels of a pixel lie side by side.
    pub channel_stride: Option<isize>,
    pub pixel_stride: isize,
    pub row_stride: isize,
}

/// An image in the caller's memory, which lives until the filter needs it no more.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Image {
    /// The first sample.
    first: *mut u8,
    sample: Sample,
    /// Channels, height, and width.
    shape: [usize; 3],
    /// Bytes from a channel, row, and column to the next one.
    strides: [isize; 3],
}

// SAFETY: a pointer alone does nothing. The caller promises that its memory may be used by other
// threads during an execution.
unsafe impl Send for Image {}
// SAFETY: as above.
unsafe impl Sync for Image {}

impl Image {
    /// The image called `name`.
    ///
    /// # Errors
    /// NULL; a format that the name does not have; a size or strides beyond the limits.
    pub(crate) fn new(
        name: &str,
        data: *mut c_void,
        format: FormatCode,
        layout: &Layout,
    ) -> Result<Self, Failure> {
        check_name(name)?;
        if data.is_null() {
            return Err(Failure::argument(format!("the memory of {name} is NULL")));
        }
        let mut formats = DemcFormat::ALL.into_iter();
        let Some(format) = formats.find(|known| *known as FormatCode == format) else {
            return Err(Failure::argument(format!(
                "{name} has the unknown format {format}"
            )));
        };
        let channels = format.channels();
        let is_wrong = match channels {
            3 => ONE.contains(&name),
            _ => THREE.contains(&name),
        };
        if is_wrong {
            return Err(Failure::argument(format!(
                "{name} has {channels} channel(s) per pixel instead of {}",
                4 - channels
            )));
        }
        let [width, height] = layout.size;
        check_size(width, height).map_err(|error| Failure::argument(format!("{name}: {error}")))?;
        let strides = strides(format, layout);
        let strides =
            strides.ok_or_else(|| Failure::argument(format!("{name} has huge strides")))?;
        let image = Self {
            first: data.cast::<u8>().wrapping_add(layout.offset),
            sample: format.sample(),
            shape: [channels, height, width],
            strides,
        };
        if image.is_addressable(data, layout.offset) {
            Ok(image)
        } else {
            Err(Failure::argument(format!(
                "{name} reaches outside of the address space"
            )))
        }
    }

    /// Whether all bytes have addresses, and not more than a slice may have.
    fn is_addressable(&self, data: *mut c_void, offset: usize) -> bool {
        let (low, high) = extent(self.sample, self.shape, self.strides);
        let first = data.addr() as i128 + offset as i128;
        let inside = first + low > 0 && first + high <= usize::MAX as i128;
        inside && high - low <= isize::MAX as i128
    }

    /// The memory of all samples: start, length, and the byte of the first sample.
    fn memory(&self) -> (*mut u8, usize, usize) {
        let (low, high) = extent(self.sample, self.shape, self.strides);
        let start = self.first.wrapping_offset(low as isize);
        (start, (high - low) as usize, -low as usize)
    }

    /// Number of channels, height, and width.
    pub(crate) fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// The image of one channel.
    pub(crate) fn channel(&self, channel: usize) -> Self {
        let distance = self.strides[0].wrapping_mul(channel as isize);
        Self {
            first: self.first.wrapping_offset(distance),
            shape: [1, self.shape[1], self.shape[2]],
            ..*self
        }
    }

    /// The image to read.
    ///
    /// # Safety
    /// The memory is the caller's image, and nobody writes to it during `'a`.
    pub(crate) unsafe fn view<'a>(&self) -> Result<View<'a>, BufferError> {
        let (start, length, first) = self.memory();
        // SAFETY: guaranteed by the caller; `new` checked the length.
        let bytes = unsafe { slice::from_raw_parts(start, length) };
        View::new(bytes, self.sample, self.shape, first, self.strides)
    }

    /// The image to write.
    ///
    /// # Safety
    /// The memory is the caller's image, and nobody else uses it during `'a`.
    pub(crate) unsafe fn view_mut<'a>(&self) -> Result<ViewMut<'a>, BufferError> {
        let (start, length, first) = self.memory();
        // SAFETY: guaranteed by the caller; `new` checked the length.
        let bytes = unsafe { slice::from_raw_parts_mut(start, length) };
        ViewMut::new(bytes, self.sample, self.shape, first, self.strides)
    }
}

/// The strides of channels, rows, and columns; `None` beyond `isize`.
fn strides(format: DemcFormat, layout: &Layout) -> Option<[isize; 3]> {
    let or_packed = |stride, packed| match stride {
        0 => packed,
        stride => Some(stride),
    };
    let [width, height] = layout.size;
    let (channels, sample) = (format.channels() as isize, format.sample().bytes() as isize);
    let packed = match layout.channel_stride {
        Some(_) => sample,
        None => channels * sample,
    };
    let pixel = or_packed(layout.pixel_stride, Some(packed))?;
    let row = or_packed(layout.row_stride, pixel.checked_mul(width as isize))?;
    let channel = match layout.channel_stride {
        Some(stride) => or_packed(stride, row.checked_mul(height as isize))?,
        None => sample,
    };
    // Far from overflows in sums of a few strides.
    channel.checked_mul(channels)?;
    row.checked_mul(height as isize)?;
    Some([channel, row, pixel])
}
