//! Why images in memory cannot be used.

use demc_data::image::exr::UnsupportedSize;

/// Why images in memory cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum BufferError {
    /// Samples lie outside the memory.
    #[error("the image of {shape} samples reaches outside of its {bytes} bytes")]
    Outside { shape: Shape, bytes: usize },
    /// Two samples of an output share memory.
    #[error(
        "samples of the output share memory: strides of {} bytes for {shape} samples",
        list(strides)
    )]
    Overlap { shape: Shape, strides: [isize; 3] },
    /// A view has another number of channels than its buffer.
    #[error("{buffer} has {found} channels instead of {expected}")]
    Channels {
        buffer: String,
        found: usize,
        expected: usize,
    },
    /// A view has another height or width than the colour.
    #[error(
        "{buffer} has {} pixels, but color has {} (height x width)",
        size(found),
        size(expected)
    )]
    Size {
        buffer: String,
        found: [usize; 2],
        expected: [usize; 2],
    },
    /// The image is empty or too large.
    #[error("color: {0}")]
    Limit(UnsupportedSize),
    /// A buffer is absent, and the model has no replacement for it.
    #[error("no {buffer}, which this model needs")]
    Missing { buffer: &'static str },
    /// A buffer has NaN or infinite samples.
    #[error(
        "{buffer} has {count} NaN or infinite sample(s); the first one is {value} in row {row}, \
         column {column}"
    )]
    NonFinite {
        buffer: String,
        count: usize,
        value: f32,
        row: usize,
        column: usize,
    },
    /// An output has another size than the image for it.
    #[error("the output has {found} samples, but the image has {expected}")]
    Output { found: usize, expected: usize },
    /// Not enough memory for a copy.
    #[error("the image needs {mib} MiB of memory, which the system does not have")]
    Memory { mib: usize },
}

/// Number of channels, rows, and columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape(
    /// Channels, height, and width.
    pub [usize; 3],
);

impl std::fmt::Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&list(&self.0).replace(", ", " x "))
    }
}

fn list<T: ToString>(values: &[T]) -> String {
    let values: Vec<String> = values.iter().map(T::to_string).collect();
    values.join(", ")
}

fn size([height, width]: &[usize; 2]) -> String {
    format!("{height}x{width}")
}
