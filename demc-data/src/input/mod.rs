//! From a whole image to the network's input space, and what is measured for it.
//!
//! [`ranges`] measures an image, [`position`] and [`preparation`] convert a whole image,
//! [`transform`] with the curves of [`transfer`] and, for KPCN, [`kpcn`] convert any part of it.

pub mod kpcn;
pub(crate) mod moments;
pub mod position;
pub mod preparation;
pub mod ranges;
pub mod transfer;
pub mod transform;
