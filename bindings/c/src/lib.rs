//! The C library of the DEMC denoiser: devices, models, and filters behind opaque handles.
//!
//! The interface follows Open Image Denoise: named images, `demcExecuteFilter`, and one error per
//! thread that the caller fetches. `include/demc.h` is generated from the doc comments of the
//! files below, in this order:
//!
//! - `error`: error codes, and the error of each thread
//! - `device`: a device with its threads
//! - `model`: a network with its weights
//! - `image`: formats of images in the caller's memory
//! - `filter`: images, options, and the work
//!
//! `handle` counts references, and `settings` holds what a filter was told. `execute` denoises. No
//! panic leaves the library.

mod device;
mod error;
mod execute;
mod filter;
mod handle;
mod image;
mod model;
mod settings;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;
