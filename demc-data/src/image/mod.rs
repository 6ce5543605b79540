//! Images in files and in memory.
//!
//! [`exr`] decodes and encodes channels, [`layout`] maps them to buffers, [`frame`] checks and holds
//! the buffers, [`rewrite`] writes a denoised image.

pub mod channel;
pub mod exr;
pub mod frame;
pub mod layout;
pub mod plane;
pub mod rewrite;
pub mod rgb;
