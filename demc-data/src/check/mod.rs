//! Mistakes that no decoder reports: in an image, and in a data set.
//!
//! [`content`] finds images without content, [`geometry`] features that do not fit together,
//! [`noise`] pixel filters, and [`doctor`] examines a whole data set.

pub mod content;
pub mod doctor;
pub mod geometry;
pub mod noise;
