//! Scores of a network: all metrics of the noisy image, an all-black image, the denoised image and
//! baselines against the reference.
//!
//! Two numbers put a score into context. At few samples per pixel, a black image already has a
//! lower RelMSE (about 2.5 to 3) than the noisy one. The reference has an error, the residual; a
//! score near it has no meaning.

mod difference;
mod score;
mod table;

pub use difference::Difference;
pub use score::{FailedImage, ImageScore, MeanScore, Report, Score, score};
pub(crate) use score::{image_of, reference_of};
