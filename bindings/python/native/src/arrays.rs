//! NumPy arrays, and all other objects with a buffer of half or float samples, as images in memory.

use std::slice;

use demc_infer::buffers::{BufferError, Sample, View, ViewMut, extent};
use pyo3::buffer::PyUntypedBuffer;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;

/// An array `[channels, height, width]` with any strides. It keeps the memory alive.
pub struct Array {
    buffer: PyUntypedBuffer,
    sample: Sample,
    shape: [usize; 3],
    strides: [isize; 3],
    /// Bytes from the start of the memory to the first sample, and size of the memory.
    first: usize,
    bytes: usize,
}

impl Array {
    /// Takes the buffer of an object. Messages call it `name`.
    ///
    /// # Errors
    /// An object without a buffer, another sample type, or other than three axes. The package has
    /// better texts for the usual mistakes.
    pub fn new(name: &str, object: &Bound<'_, PyAny>) -> PyResult<Self> {
        let buffer = PyUntypedBuffer::get(object)?;
        let sample = match buffer.format().to_bytes() {
            b"e" | b"@e" | b"=e" => Sample::Half,
            b"f" | b"@f" | b"=f" => Sample::Float,
            _ => {
                let text = format!("{name} must be float32 or float16 in the machine's byte order");
                return Err(PyTypeError::new_err(text));
            }
        };
        let axes = (buffer.shape().try_into(), buffer.strides().try_into());
        let (Ok(shape), Ok(strides), None) = (axes.0, axes.1, buffer.suboffsets()) else {
            return Err(PyValueError::new_err(format!("{name} must have 3 axes")));
        };
        // A buffer is in memory, so its extent has the size of an address.
        let (low, high) = extent(sample, shape, strides);
        let (first, bytes) = (-low as usize, (high - low) as usize);
        Ok(Self {
            buffer,
            sample,
            shape,
            strides,
            first,
            bytes,
        })
    }

    /// The samples, to read. Python code must not write to them meanwhile: as in NumPy, the GIL does
    /// not prevent it.
    ///
    /// # Errors
    /// None for a buffer that its exporter describes correctly.
    pub fn view(&self) -> Result<View<'_>, BufferError> {
        let bytes: &[u8] = match self.bytes {
            0 => &[],
            // SAFETY: the exporter guarantees that all samples from the lowest to the highest address
            // lie in memory that lives as long as the buffer. Bytes between the samples of an array
            // with strides belong to the array that it is a part of.
            bytes => unsafe { slice::from_raw_parts(self.start(), bytes) },
        };
        View::new(bytes, self.sample, self.shape, self.first, self.strides)
    }

    /// The samples, to write.
    ///
    /// # Errors
    /// Two samples at one place.
    pub fn view_mut(&mut self) -> Result<ViewMut<'_>, BufferError> {
        let bytes: &mut [u8] = match self.bytes {
            0 => &mut [],
            // SAFETY: as in `view`. The memory is writable (`check_writable`), and no other slice of
            // this crate exists while the output is written.
            bytes => unsafe { slice::from_raw_parts_mut(self.start(), bytes) },
        };
        ViewMut::new(bytes, self.sample, self.shape, self.first, self.strides)
    }

    /// Refuses an array that cannot be written to. Call it before [`view_mut`](Self::view_mut).
    ///
    /// # Errors
    /// A read-only array, or one whose samples share memory.
    pub fn check_writable(&mut self, name: &str) -> PyResult<()> {
        if self.buffer.readonly() {
            return Err(PyValueError::new_err(format!("{name} is read-only")));
        }
        if self.bytes == 0 {
            // An image without pixels is refused elsewhere.
            return Ok(());
        }
        let shared = self.view_mut().err();
        shared.map_or(Ok(()), |error| {
            Err(PyValueError::new_err(format!("{name}: {error}")))
        })
    }

    fn start(&self) -> *mut u8 {
        let first = self.buffer.buf_ptr().cast::<u8>();
        first.wrapping_sub(self.first)
    }
}
