//! A rendered image with its feature buffers, checked. All buffers cover the same pixels, no value
//! is NaN or infinite, and no radiance is negative. [`FramePlanes`] keeps the file's precision;
//! [`Frame`] is `f32`.

mod buffers;
mod channels;
pub mod layers;
mod light;
mod passes;
mod read;

pub use buffers::{
    FEATURE_NAMES, FEATURES, Frame, FramePlanes, MAX_ALBEDO, POSITIONS, Presence, TEXTURES,
};
pub(crate) use light::DEPTH;
pub use light::{LIGHT, PASS_PLANES, PASSES, REFERENCE_PASSES};
pub use passes::{PassPlanes, decode_passes};
pub use read::{
    check_header, check_open_header, decode_input, decode_repaired, read_frame, read_input,
};
pub(crate) use read::{frame_of, read_pair};
